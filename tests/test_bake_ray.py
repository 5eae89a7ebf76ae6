"""Engine ``ray`` on real local clusters: actors are killed, nodes join and leave, the bytes stay
the same."""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from bakes import files, plan_in
from test_generator import write

import lidar_synth.bake.ray_actors as module
from lidar_synth.bake import ENGINES, BakePlan, Resources, bake
from lidar_synth.bake.folder import finish, prepare
from lidar_synth.bank.index import SETTINGS
from lidar_synth.errors import ConfigError, FileError

ray = pytest.importorskip(
    "ray", reason="ray is not installed: pip install 'lidar_synth[ray]'"
)

NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture
def plan(model: Path, tmp_path: Path) -> BakePlan:
    return plan_in(tmp_path / "bank", model)


@pytest.fixture(scope="module", autouse=True)
def settings() -> Iterator[None]:
    """No usage statistics, and workers with normal scheduling priority."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")
        yield


@pytest.fixture(scope="module")
def cluster(settings: None) -> Iterator[Any]:
    """A node with one core, and this process connected to it."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args=NODE)
    ray.init(address=cluster.address, log_to_driver=False)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def actors() -> set[int]:
    """Process ids of the running actors on this machine."""
    running = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            name = path.read_bytes()
        except OSError:
            continue  # it has ended
        if name.startswith(b"ray::Baker"):
            running.add(int(path.parent.name))
    return running


def becomes_true(condition: Callable[[], bool], seconds: float = 200) -> bool:
    """Wait until a condition holds, at most this long; whether it holds."""
    end = time.monotonic() + seconds
    while not (holds := condition()) and time.monotonic() < end:
        time.sleep(0.05)
    return holds


def writing(plan: BakePlan) -> set[int]:
    """Ids of the processes that are writing a shard, from the temporary files in the folder."""
    return {
        int(part.name.removesuffix(".part").rpartition("-")[2])
        for part in plan.out.glob(".*.part")
    }


def test_the_engine_starts_and_stops_its_own_cluster(
    plan: BakePlan, model: Path, tmp_path: Path
) -> None:
    """Without an address the engine starts Ray and stops it; without a running cluster 'auto' is
    refused."""
    with pytest.raises(
        ConfigError, match="Ray address 'auto' .*; expected a running cluster"
    ):
        bake(plan, "ray", Resources(1, "auto"), progress=False)
    assert bake(plan, "ray", Resources(2), progress=False) is not None
    assert not ray.is_initialized()
    reference = plan_in(tmp_path / "reference" / "bank", model)
    bake(reference, progress=False)
    assert files(plan.out) == files(reference.out)


@pytest.mark.timeout(900)
def test_a_bake_survives_lost_actors_and_nodes(
    cluster: Any, model: Path, tmp_path: Path
) -> None:
    """A second node joins; an actor of the first node and later the second node are killed while
    they write a shard."""
    single, plan = (
        plan_in(tmp_path / name / "bank", model, count=1200, shard_size=40)
        for name in ("single", "upset")
    )
    bake(single, progress=False)
    prepare(plan)
    reported: list[int] = []
    first: set[int] = set()
    second: set[int] = set()
    nodes: list[Any] = []
    upsets: list[str] = []

    def progress(scans: int) -> None:
        reported.append(scans)
        if not upsets:
            first.update(actors())
            nodes.append(cluster.add_node(**NODE))
            assert becomes_true(lambda: len(actors()) == 2)
            second.update(actors() - first)
            upsets.append("a node joined")
        elif upsets == ["a node joined"] and (busy := writing(plan) & first):
            os.kill(busy.pop(), signal.SIGKILL)
            upsets.append("an actor was killed")
        elif upsets[-1] == "an actor was killed" and becomes_true(
            lambda: len(actors() - first) == 2, 10
        ):
            # Not before this returns and the engine hears of the loss.
            upsets.append("another started")
        elif upsets[-1] == "another started" and writing(plan) & second:
            cluster.remove_node(nodes.pop(), allow_graceful=False)
            assert becomes_true(lambda: not actors() & second)
            upsets.append("a node left")

    ENGINES["ray"](plan, range(30), Resources(2), progress)
    assert upsets == [
        "a node joined",
        "an actor was killed",
        "another started",
        "a node left",
    ]
    assert len(first) == 1 and len(second) == 1 and sum(reported) == 1200
    assert finish(plan) is not None
    assert files(plan.out) == files(single.out)


def test_an_error_of_an_actor_is_raised(cluster: Any, plan: BakePlan) -> None:
    prepare(plan)
    (plan.out / SETTINGS).unlink()
    with pytest.raises(FileError, match="has vanished or lost its .bake.json"):
        ENGINES["ray"](plan, range(4), Resources(1), lambda scans: None)


class Dying(module.Baker):
    """An actor on a node without memory."""

    def bake(self, number: int) -> int:
        os._exit(1)


def test_actors_that_never_finish_a_shard_stop_the_bake(
    cluster: Any, plan: BakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LOSSES", 1)
    monkeypatch.setattr(module, "Baker", Dying)
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    prepare(plan)
    with pytest.raises(
        FileError,
        match=r"(?s)2 Ray actors were lost without a finished.*finished shards are kept",
    ):
        ENGINES["ray"](plan, range(4), Resources(1), lambda scans: None)
    assert not list(plan.out.glob("*.h5"))
