"""Workers on a Dask cluster give what threads give."""

import os
import signal
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_people import OPTIONS, toy

from habitus.errors import HabitusError
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.jobs.train import train
from habitus.parallel.queue import Lost, Spread
from habitus.parallel.workers import Cluster, connect, pickled_size

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def address():
    """A cluster of two processes on this machine."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    """The toy data set as it is read from disk."""
    path = tmp_path_factory.mktemp("people") / "people.npz"
    write_registrations(toy()[1].registrations, path)
    return open_registrations(path)


def test_the_cluster_trains_the_same_model(address, people, tmp_path):
    template = toy()[0]
    options = replace(OPTIONS, rounds=1)
    few = people.take(np.r_[:14, 28:38])
    more = {"template": template, "options": options}
    (here,) = train(few, tmp_path / "here", workers=1, **more)
    (there,) = train(few, tmp_path / "there", workers=address, **more)
    here = here.trained
    there = there.trained
    for name in ("v_template", "shapedirs", "posedirs", "joint_regressor", "skinning_weights"):
        torch.testing.assert_close(
            getattr(there.body, name), getattr(here.body, name), rtol=0, atol=1e-9
        )
    np.testing.assert_allclose(there.estimate.pose, here.estimate.pose, rtol=0, atol=1e-9)


def test_results_come_in_order_and_few_wait(address):
    with connect(address) as workers:
        found = []
        most = 0
        for result in workers.map(divmod, 100, range(1, 40)):
            found.append(result)
            most = max(most, len(workers.client.futures))
        assert found == [divmod(100, k) for k in range(1, 40)]
        assert most <= 2 * workers.ahead + 2


def fragile(shared: str, item: int) -> int:
    """Twice the item; the first process that comes to 7 dies."""
    if item == 7 and not Path(shared).exists():
        Path(shared).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * item


def test_the_work_of_a_machine_that_dies_is_done_by_another(address, tmp_path):
    with connect(address) as workers:
        found = list(workers.map(fragile, str(tmp_path / "died"), range(20)))
    assert found == [2 * k for k in range(20)] and (tmp_path / "died").exists()


def test_a_queue_does_what_earlier_results_call_for(address):
    todo = [5]
    found = {}
    with connect(address) as workers:
        for item, result in Spread(workers).done(divmod, 100, lambda: todo.pop() if todo else None):
            found[item] = result
            todo.extend([item + 1, item + 10] if item < 8 else [])
    assert found == {k: divmod(100, k) for k in (5, 6, 7, 8, 15, 16, 17)}


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (distributed.scheduler.KilledWorker("one", None, 3), Lost),
        (distributed.comm.CommClosedError("gone"), HabitusError),
    ],
)
def test_an_item_that_kills_processes_is_lost_and_a_scheduler_that_is_gone_ends_all(error, told):
    class Client(Forgetful):
        def submit(self, function, *arguments, **_):
            future = Future()
            future.set_exception(error)
            return future

    todo = ["one"]
    queue = Spread(Cluster(Client(0))).done(divmod, 1, lambda: todo.pop() if todo else None)
    if told is Lost:
        ((item, result),) = queue
        assert item == "one" and isinstance(result, Lost) and "too little memory" in str(result)
    else:
        with pytest.raises(HabitusError, match="goes on once it is back"):
            list(queue)


def test_a_queue_sends_again_what_the_scheduler_forgot():
    todo = [4, 3]
    found = dict(
        Spread(Cluster(Forgetful(1))).done(divmod, 100, lambda: todo.pop() if todo else None)
    )
    assert found == {3: divmod(100, 3), 4: divmod(100, 4)}


class Forgetful:
    """A scheduler that forgets the first tasks it is sent."""

    status = "running"

    def __init__(self, forgets):
        self.forgets = forgets

    def nthreads(self):
        return {"one": 1}

    def scatter(self, things, **_):
        return things

    def submit(self, function, *arguments, **_):
        future = Future()
        self.forgets = self.forgets - 1
        if self.forgets >= 0:
            future.cancel()
        else:
            future.set_result(function(*arguments))
        return future

    def cancel(self, futures, reason):
        pass


@pytest.mark.parametrize(
    ("forgets", "status", "lost"),
    [(2, "running", False), (50, "running", True), (1, "closed", True)],
)
def test_a_task_that_the_scheduler_forgot_is_sent_again(forgets, status, lost):
    client = Forgetful(forgets)
    client.status = status
    results = Cluster(client).map(divmod, 100, range(1, 9))
    if lost:
        with pytest.raises(HabitusError, match="the cluster was lost"):
            list(results)
    else:
        assert list(results) == [divmod(100, k) for k in range(1, 9)]


def test_bad_input_is_said_as_without_a_cluster(address, people):
    with (
        connect(address) as workers,
        pytest.raises(HabitusError, match="registrations 99 to 99 asked for"),
    ):
        list(workers.map(type(people).take, people, [np.array([1]), np.array([99])]))


def test_a_lost_cluster_is_said_in_one_line():
    cluster = distributed.LocalCluster(n_workers=1, processes=True, dashboard_address=":0")
    with cluster, connect(cluster.scheduler_address) as workers:
        results = workers.map(divmod, 100, range(1, 40))
        next(results)
        cluster.close()
        with pytest.raises(HabitusError, match="the cluster was lost"):
            list(results)


def test_readers_travel_without_data_and_arrays_with_them(people):
    vertices = np.zeros((50, 1000, 3))
    assert pickled_size(people.vertices) < 5000 < people.num_vertices * 3 * 4 * len(people)
    assert vertices.nbytes <= pickled_size((vertices, "words")) < vertices.nbytes + 1000
