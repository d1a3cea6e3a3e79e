"""An objective: weighted terms of the same unknowns, read, checked and evaluated once at the
start.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.solve.terms import BoundTerm, Outcome, read_terms
from habitus.solve.unknowns import Unknowns, as_numpy


@dataclass(frozen=True, eq=False)
class Objective:
    """Weighted terms of the same unknowns: cost(x) = sum of weight * 1/2 |residual|^2."""

    unknowns: Unknowns
    terms: tuple[BoundTerm, ...]
    _recent: dict[bytes, list[tuple[BoundTerm, Outcome]]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, objective: Any, weights: Mapping[str, float] | None, unknowns: Unknowns
    ) -> "Objective":
        """Terms as in `minimize`, each evaluated once at the start."""
        values = unknowns.values(unknowns.vector)
        terms = []
        outcomes = []
        for term in read_terms(objective, weights or {}, unknowns.names):
            found = term(values)
            count = 1 if found.residual.ndim == 0 else len(found.value)
            terms.append(replace(term, count=count, explicit=found.explicit, is_cost=found.is_cost))
            outcomes.append(found)
        made = cls(unknowns, tuple(terms))
        made._remember(
            unknowns.vector, [pair for pair in zip(terms, outcomes, strict=True) if pair[0].weight]
        )
        return made

    @property
    def active(self) -> tuple[BoundTerm, ...]:
        """The terms of any weight."""
        return tuple(term for term in self.terms if term.weight)

    def evaluate(self, x: Float[np.ndarray, " N"]) -> list[tuple[BoundTerm, Outcome]]:
        """Each active term with what it gives at x; the two latest answers are kept."""
        found = self._recent.get(x.tobytes())
        if found is None:
            values = self.unknowns.values(x)
            found = [(term, term(values)) for term in self.active]
        self._remember(x, found)
        return found

    def _remember(self, x: Float[np.ndarray, " N"], found: list[tuple[BoundTerm, Outcome]]) -> None:
        self._recent.pop(x.tobytes(), None)
        self._recent[x.tobytes()] = found
        while len(self._recent) > 2:
            del self._recent[next(iter(self._recent))]

    def costs(self, x: Float[np.ndarray, " N"]) -> dict[str, float]:
        """The weighted cost of each term."""
        found = {
            term.name: term.weight * float(as_numpy(outcome.cost))
            for term, outcome in self.evaluate(x)
        }
        return {term.name: found.get(term.name, 0.0) for term in self.terms}

    def free(self, term: BoundTerm) -> tuple[str, ...]:
        """The free unknowns that a term takes."""
        return tuple(name for name in term.takes if name in self.unknowns.start)


def total_cost(found: Collection[tuple[BoundTerm, Outcome]]) -> float:
    """Weighted sum of the costs."""
    return sum(term.weight * float(as_numpy(outcome.cost)) for term, outcome in found)
