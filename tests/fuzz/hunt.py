"""The long hunt: many spoilt files given to every reader, in processes with little memory and
little time.

    python tests/fuzz/hunt.py --mutants 100000 --workers 2
    python tests/fuzz/hunt.py --seconds 60

Each mutant has 10 seconds and its file's own size and 1 GB of memory. What fails lies in the folder
of findings, a folder a mutant, beside findings.json; a mutant is made again by its number.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent
SLOWEST_S = 10.0
MOST_BYTES = 1 << 30


def main() -> None:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after these")
    parser.add_argument("--only", default="", help="part of a target's name")
    parser.add_argument(
        "--findings", type=Path, default=Path(tempfile.gettempdir()) / "habitus-fuzz"
    )
    parser.add_argument("--work", nargs=2, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    sys.path[:0] = [str(HERE), str(HERE.parent / "helpers")]
    if options.work:
        _work(*options.work, options)
    else:
        sys.exit(_hunt(options))


# -- a worker --------------------------------------------------------------------------------------


def _work(first: int, step: int, options: argparse.Namespace) -> None:
    """Try mutants one after the other, each told on a line when it begins and when it ends."""
    from attempts import attempt, spoilt
    from targets import all_targets

    targets = tuple(target for target in all_targets() if options.only in target.name)
    folder = Path(tempfile.mkdtemp(prefix="habitus-fuzz-"))
    for target in targets:  # what is compiled or imported at the first use is not the mutant's
        attempt(target, target.trees[0], folder / "mutant")
    resource.setrlimit(resource.RLIMIT_AS, (_kilobytes("VmSize") * 1024 + 2 * MOST_BYTES,) * 2)
    for number in range(first, options.first + options.mutants, step):
        target, tree = spoilt(targets, number)
        before = _kilobytes("VmRSS")
        most = MOST_BYTES + sum(map(len, tree.values()))
        _say("begin", number, target.name)
        wrong = attempt(target, tree, folder / "mutant")
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
        if grown > most:
            wrong = f"it took {grown / 1e9:.2f} GB: {wrong}"
        _say("end", number, wrong or "")
        if grown > most:
            return  # the greatest size of a process never shrinks: a new one goes on


def _kilobytes(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key))


def _say(*words: object) -> None:
    sys.__stdout__.write(json.dumps(words) + "\n")
    sys.__stdout__.flush()


# -- the hunt --------------------------------------------------------------------------------------


@dataclass
class _Worker:
    """A process that tries every ``step``-th mutant, and what it is at."""

    next: int
    step: int
    options: argparse.Namespace
    process: subprocess.Popen | None = None
    rest: bytes = b""
    number: int = -1
    target: str = ""
    since: float = 0.0
    began: float = 0.0
    done: Counter = field(default_factory=Counter)

    def poll(self) -> Iterator[tuple[int, str, str]]:
        """What it has found since it was last asked: (mutant, target, what is wrong)."""
        if self.process is None:
            if self.next < self.options.first + self.options.mutants:
                self._start()
            return
        yield from self._heard()
        stuck = self.number >= 0 and _seconds(self.process.pid) - self.since > SLOWEST_S
        stuck |= (
            self.number >= 0 and time.monotonic() - self.began > 30 * SLOWEST_S
        )  # it waits, on whatever
        ended = self.process.poll() is not None
        if ended:
            yield from self._heard()
        if stuck or ended:
            self.process.kill()
            code = self.process.wait()
            if self.number >= 0:
                yield self._lost(
                    f"it hung for {SLOWEST_S:g} s" if stuck else f"the process died ({code})"
                )
            elif code:
                raise SystemExit(f"a worker ended with {code} before it began")
            self.process = None

    @property
    def finished(self) -> bool:
        """Whether all of its mutants are tried."""
        return self.process is None and self.next >= self.options.first + self.options.mutants

    def stop(self) -> None:
        """End it, whatever it is at."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def _start(self) -> None:
        command = [sys.executable, __file__, "--work", str(self.next), str(self.step)]
        for key in ("mutants", "first", "only"):
            command += [f"--{key}", str(getattr(self.options, key))]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert self.process.stdout is not None
        os.set_blocking(self.process.stdout.fileno(), False)
        self.rest = b""
        self.number = -1

    def _heard(self) -> Iterator[tuple[int, str, str]]:
        assert self.process is not None and self.process.stdout is not None
        *lines, self.rest = (self.rest + (self.process.stdout.read() or b"")).split(b"\n")
        for line in lines:
            what, number, text = json.loads(line)
            if what == "begin":
                self.number = number
                self.target = text
                self.since = _seconds(self.process.pid)
                self.began = time.monotonic()
                continue
            self.done[self.target] += 1
            self.number = -1
            self.next = number + self.step
            if text:
                yield number, self.target, text

    def _lost(self, why: str) -> tuple[int, str, str]:
        self.done[self.target] += 1
        self.next = self.number + self.step
        return self.number, self.target, why


def _seconds(process: int) -> float:
    """The time that a process has worked: on a busy machine it is not the time that passed."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _hunt(options: argparse.Namespace) -> int:
    workers = [_Worker(options.first + k, options.workers, options) for k in range(options.workers)]
    found: list[tuple[int, str, str]] = []
    started = shown = time.monotonic()
    print(f"mutants from number {options.first} on, the same ones each time", flush=True)
    while not all(worker.finished for worker in workers):
        if time.monotonic() - started > options.seconds:
            for worker in workers:
                worker.stop()
            break
        for worker in workers:
            for one in worker.poll():
                found.append(one)
                print(f"mutant {one[0]}, {one[1]}: {one[2]}", flush=True)
        if time.monotonic() - shown > 60:
            shown = time.monotonic()
            print(
                f"{sum(sum(w.done.values()) for w in workers)} tried, {shown - started:.0f} s",
                flush=True,
            )
        time.sleep(0.05)
    done = sum((worker.done for worker in workers), Counter())
    _keep(found, done, options)
    print(
        f"{sum(done.values())} mutants in {time.monotonic() - started:.0f} s, {len(found)} "
        "answered wrongly"
    )
    return 1 if found else 0


def _keep(found: list[tuple[int, str, str]], done: Counter, options: argparse.Namespace) -> None:
    from attempts import spoilt
    from targets import all_targets

    options.findings.mkdir(parents=True, exist_ok=True)
    findings = {"tried": dict(sorted(done.items())), "wrong": found}
    (options.findings / "findings.json").write_text(json.dumps(findings, indent=1))
    targets = (
        tuple(target for target in all_targets() if options.only in target.name) if found else ()
    )
    for number, _, _ in found[:200]:
        for name, content in spoilt(targets, number)[1].items():
            file = options.findings / str(number) / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)


if __name__ == "__main__":
    main()
