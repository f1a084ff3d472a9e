"""Who collects makes no difference: the same arenas, the same data, and nothing lost."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore.config.run import RunConfig
from marl_explore.policies.actors import TeamActor
from marl_explore.policies.networks import MLP, OBSERVATION_KEYS
from marl_explore.training import clusters, runs, trainer
from marl_explore.training.checkpoint import list_checkpoints, read_checkpoint, write_checkpoint
from marl_explore.training.collectors import make_collector
from marl_explore.training.environment import make_training_env
from marl_explore.training.restarts import RestartingCollector
from marl_explore.training.rollout_metrics import METRIC_KEYS
from marl_explore.training.trainer import Trainer
from marl_explore.training.workers import WorkerDeathError, WorkerError
from tests.helpers.killing import CONFIG

TWO = RunConfig(collector="multisync", workers=2, checkpoint_every=0, validate_every=0)


class Likeliest(TeamActor):
    """A team that always takes the likeliest actions."""

    def forward(self, tensordict):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return super().forward(tensordict)


def rollouts(run, batches=2, policy_class=Likeliest, config=CONFIG, keep=None):
    """Some batches of a team that was never trained, which stay as they are."""
    torch.manual_seed(0)
    actors = [MLP(hidden=(16,)).make_actor(config.arena) for _ in range(2)]
    with torch.no_grad():
        for actor in actors:  # far apart, so that roundings choose no action
            actor.layers[-1].weight.mul_(100)
    create_env = partial(make_training_env, config)
    team = policy_class(actors)
    collector = make_collector(create_env, team, num_envs=4, steps=9, run=run, keep=keep)
    collected, copies = [], []
    for _, batch in zip(range(batches), collector, strict=False):
        collected.append(batch)
        copies.append(batch.clone())
    assert all((one == other).all() for one, other in zip(collected, copies, strict=True))
    collector.shutdown()
    return torch.cat(copies, 1)


@pytest.fixture(scope="module")
def here():
    return rollouts(RunConfig())


WIDE = replace(
    CONFIG,
    arena=replace(
        CONFIG.arena,
        sensing_range=(1.5, 2.0),
        sensing_shape="disc",
        line_of_sight=True,
        wall_loss_db=3.0,
        shadowing_db=4.0,
        message_loss=0.2,
        move_period=(1, 2),
        failure_rate=0.05,
        num_walkers=1,
    ),
)


def assert_same_data(there, here):
    assert there.shape == here.shape == (4, 18)
    for key in here.keys(True, True):
        if "action_log_prob" in key:
            torch.testing.assert_close(there[key], here[key], atol=1e-5, rtol=0)
        elif "traj_ids" not in key:
            assert torch.equal(there[key], here[key]), key


@pytest.mark.parametrize("workers", [1, 2])
def test_the_number_of_workers_does_not_change_the_data(here, workers):
    assert_same_data(rollouts(RunConfig(collector="multisync", workers=workers)), here)
    assert here["next", "done"].any()


def test_workers_see_the_same_wider_world():
    here = rollouts(RunConfig(), config=WIDE)
    assert not here["agents", "alive"].all()
    assert_same_data(rollouts(RunConfig(collector="multisync", workers=2), config=WIDE), here)


def test_training_in_a_wider_world_goes_on_as_if_it_had_never_stopped():
    alone = RunConfig(checkpoint_every=0, validate_every=0)
    whole, states = Trainer(WIDE, alone), []
    curve = run_to(whole, CONFIG.updates, lambda run: states.append(deepcopy(run.state_dict())))
    resumed = Trainer(WIDE, alone)
    resumed.load_state_dict(states[0])
    assert repr(run_to(resumed, CONFIG.updates)) == repr(curve[3:])
    assert all(torch.equal(a, b) for a, b in zip(weights(resumed), weights(whole), strict=True))


def test_workers_draw_different_actions():
    data = rollouts(TWO, batches=1, policy_class=TeamActor)
    assert not torch.equal(data["agents", "action"][:2], data["agents", "action"][2:])


def test_workers_share_the_arenas_of_an_asynchronous_collector(here):
    data = rollouts(RunConfig(collector="multiasync", workers=2))
    assert data.shape == (2, 36)  # batches of half of the arenas, twice as long
    starts = here["obstacles"][:, 0]
    assert any(torch.equal(data["obstacles"][:, 0], half) for half in (starts[:2], starts[2:]))


def weights(run):
    return [p.clone() for p in run.learners["team"].loss.parameters()]


def run_to(run, updates, disturb=None):
    """Train up to an update; its metrics but times."""
    metrics = []
    for row in run.run():
        metrics.append({k: v for k, v in row.items() if k not in ("seconds", "rate")})
        if run.updates == 3 and disturb is not None:
            disturb(run)
        if run.updates == updates:
            break
    return metrics


@pytest.fixture(scope="module")
def with_workers():
    run = Trainer(CONFIG, TWO)
    run.collect = partial(collect_checked, run, run.collect)
    return repr(run_to(run, CONFIG.updates)), weights(run)


def collect_checked(run, collect):
    """A batch, once it is clear that the newest parameters chose its actions."""
    (batch,) = collect()
    team = run.policy.team
    logits = team.stacked(*(batch[key] for key in OBSERVATION_KEYS))
    logits = logits.masked_fill(~batch["agents", "action_mask"], -torch.inf)
    chosen = batch["agents", "action"].unsqueeze(-1)
    expected = logits.log_softmax(-1).gather(-1, chosen).squeeze(-1)
    torch.testing.assert_close(batch["agents", "action_log_prob"], expected, atol=1e-5, rtol=0)
    return [batch]


def kill_worker(run):
    (rollouts,) = run.rollouts.collectors
    os.kill(rollouts._collector.procs[1].pid, signal.SIGKILL)


def test_a_worker_that_is_killed_is_replaced_and_nothing_changes(with_workers, caplog):
    run = Trainer(CONFIG, TWO)
    with caplog.at_level(logging.WARNING, "marl_explore"):
        metrics = run_to(run, CONFIG.updates, disturb=kill_worker)
    assert "restarting all workers" in caplog.text
    curve, parameters = with_workers
    assert repr(metrics) == curve
    assert all(torch.equal(a, b) for a, b in zip(weights(run), parameters, strict=True))


def killing_env(*, num_envs, first_arena, marker):
    """An environment; the first time that worker 1 makes it, the worker is killed instead."""
    if first_arena == 2 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return make_training_env(CONFIG, num_envs=num_envs, first_arena=first_arena)


START = """
import sys
from functools import partial
from multiprocessing import set_start_method
from pathlib import Path
from marl_explore.training.collectors import make_collector
from marl_explore.config.run import RunConfig
from marl_explore.training.restarts import RestartingCollector
from marl_explore.training.trainer import Trainer
from tests.helpers.killing import CONFIG
from tests.training.test_collectors import killing_env
if __name__ == "__main__":
    set_start_method(sys.argv[1], force=True)
    run = RunConfig(collector=sys.argv[2], workers=2)
    env, team = partial(killing_env, marker=Path(sys.argv[3])), Trainer(CONFIG).policy.team
    start = partial(make_collector, env, team, num_envs=4, steps=5, run=run)
    rollouts = RestartingCollector(start, team, run, num_envs=4)
    print(rollouts.next().numel())
    rollouts.close()
"""


@pytest.mark.parametrize(
    ("method", "kind"), [("fork", "multisync"), ("spawn", "multisync"), ("spawn", "multiasync")]
)
def test_a_worker_that_is_killed_while_it_starts_is_replaced(tmp_path, method, kind):
    script, marker = tmp_path / "script.py", tmp_path / "killed"
    script.write_text(START)
    done = subprocess.run(
        [sys.executable, str(script), method, kind, str(marker)],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert (done.returncode, done.stdout) == (0, "20\n"), done.stderr
    assert marker.exists()
    assert "worker 1 was killed by SIGKILL; restarting all workers (1)" in done.stderr


class Faulty(TeamActor):
    """A team whose second batch meets a mistake."""

    calls = 0

    def forward(self, tensordict):
        self.calls += 1
        if self.calls == 7:
            raise RuntimeError("this is a mistake")
        return super().forward(tensordict)


@pytest.mark.parametrize("kind", ["multisync", "multiasync"])
def test_an_error_of_a_worker_is_raised_at_once(kind, caplog):
    run = replace(TWO, collector=kind)
    create_env, starts = partial(make_training_env, CONFIG), []
    team = Faulty([MLP(hidden=(16,)).make_actor(CONFIG.arena) for _ in range(2)])

    def start(first_arena):
        starts.append(first_arena)
        return make_collector(create_env, team, num_envs=4, steps=5, run=run)

    rollouts = RestartingCollector(start, team, run, num_envs=4)
    batches = iter(rollouts.next, None)
    with pytest.raises(
        WorkerError, match="worker [01] failed with RuntimeError: this is a mistake"
    ):
        list(batches)
    rollouts.close()
    assert starts == [0]


def broken_env(*, num_envs, first_arena):
    raise OSError("no such arenas")


def test_an_error_while_workers_start_is_raised_at_once():
    team = Trainer(CONFIG).policy.team
    start = partial(make_collector, broken_env, team, num_envs=4, steps=5, run=TWO)
    with pytest.raises(WorkerError, match="collecting failed: OSError: no such arenas"):
        RestartingCollector(start, team, TWO, num_envs=4).next()


def test_with_workers_a_run_goes_on_exactly_from_a_checkpoint(with_workers, tmp_path):
    stopped = Trainer(CONFIG, TWO)
    curve = run_to(stopped, 5)
    path = write_checkpoint(tmp_path, 5, stopped.state_dict(), keep=1)
    resumed = Trainer(CONFIG, TWO)
    resumed.load_state_dict(read_checkpoint(path))
    curve += run_to(resumed, CONFIG.updates)
    assert repr(curve) == with_workers[0]
    assert all(torch.equal(a, b) for a, b in zip(weights(resumed), with_workers[1], strict=True))


def test_the_number_of_workers_must_stay():
    state = Trainer(CONFIG).state_dict()
    state["rollouts"] = [{"returns": torch.zeros(4, 1)}]
    with pytest.raises(ValueError, match="workers=2 is not allowed: the state is for 1"):
        Trainer(CONFIG, TWO).load_state_dict(state)


def test_workers_must_divide_the_arenas():
    with pytest.raises(ValueError, match="workers=3 is not allowed: it must divide num_envs=4"):
        Trainer(CONFIG, replace(TWO, workers=3))


def test_ray_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(clusters, "find_spec", lambda package: None)
    with pytest.raises(ValueError, match="collector='ray' needs the package ray: pip install ray"):
        Trainer(CONFIG, RunConfig(collector="ray"))


@pytest.mark.parametrize("run", [RunConfig(), TWO], ids=["process", "multisync"])
def test_entries_that_are_left_out_change_nothing(here, run):
    kept = rollouts(run, keep=METRIC_KEYS)
    assert set(kept.exclude("collector").keys(True, True)) == set(METRIC_KEYS)
    for key in METRIC_KEYS:
        assert torch.equal(kept[key], here[key]), key


def test_asynchronous_workers_send_what_is_kept():
    run = RunConfig(collector="multiasync", workers=2)
    kept = rollouts(run, batches=6, keep=METRIC_KEYS)
    assert set(kept.exclude("collector").keys(True, True)) == set(METRIC_KEYS)
    assert kept["next", "step_count"].min() == 1


class Doomed:
    """A collector whose workers die in every batch but the first ``lives``."""

    def __init__(self, collector, lives):
        self._collector, self._lives = collector, lives

    def __iter__(self):
        for batch in self._collector:
            self._lives -= 1
            if self._lives < 0:
                raise WorkerDeathError("worker 0 was killed by SIGKILL")
            yield batch

    def __getattr__(self, name):
        return getattr(self._collector, name)


def test_workers_that_die_again_and_again_end_the_run_with_nothing_lost(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    lives = iter([2, 0, 0, 0])

    def start(*args, run, **kwargs):
        return Doomed(make_collector(*args, **kwargs), next(lives))

    monkeypatch.setattr(trainer, "make_collector", start)
    with pytest.raises(
        WorkerError, match=r"died 4 times in a row.*; update 2 of 12 is saved.*resume"
    ):
        runs.train(CONFIG, folder, replace(TWO, workers=1), progress=False)
    (last,) = list_checkpoints(folder)
    assert read_checkpoint(last)["trainer"]["updates"] == 2


def test_asynchronous_workers_start_again_with_new_arenas():
    first_arenas = []

    def start(first_arena):
        first_arenas.append(first_arena)
        create_env = partial(make_training_env, CONFIG)
        collector = make_collector(create_env, team, num_envs=4, steps=5, first_arena=first_arena)
        return Doomed(collector, lives=3)

    team = Trainer(CONFIG).policy.team
    rollouts = RestartingCollector(
        start, team, RunConfig(collector="multiasync", workers=2), num_envs=4
    )
    for _ in range(5):
        rollouts.next()
    assert rollouts.state() == []
    assert first_arenas == [0, 12]


SCRIPT = """
import sys
from dataclasses import replace
from marl_explore.cli.common import run_program
from marl_explore.training import runs
from marl_explore.training.workers import WorkerDeathError, WorkerError
from tests.helpers.killing import CONFIG
from tests.training.test_collectors import TWO
if __name__ == "__main__":
    config = replace(CONFIG, episodes=10**6)
    run_program(lambda: config, lambda config: runs.train(config, sys.argv[1], TWO, progress=False))
"""


@pytest.fixture
def long_run(tmp_path):
    """A program that trains with two workers, as the leader of a process group."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    folder = tmp_path / "run"
    program = subprocess.Popen(
        [sys.executable, str(script), str(folder)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        start_new_session=True,
    )
    deadline = time.monotonic() + 300
    while not (folder / "scalars" / "reward.csv").exists():
        assert program.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    yield program, folder
    program.kill()
    program.communicate()


def children(pid):
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def test_ctrl_c_reaches_the_main_process_alone_and_ends_it_in_good_order(long_run):
    program, folder = long_run
    workers = children(program.pid)
    os.killpg(program.pid, signal.SIGINT)
    _, errors = program.communicate(timeout=60)
    assert program.returncode == 128 + signal.SIGINT
    assert errors.splitlines()[-1].startswith("stopped by SIGINT; update ")
    assert "Traceback" not in errors
    assert len(list_checkpoints(folder)) == 1
    assert_gone(workers)


def test_workers_end_when_the_main_process_is_killed(long_run):
    program, _ = long_run
    workers = children(program.pid)
    assert len(workers) >= 2
    program.kill()
    assert_gone(workers)


def assert_gone(workers):
    deadline = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.1)
