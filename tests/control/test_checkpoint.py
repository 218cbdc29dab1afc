"""Runs of agents that are interrupted, and go on as if they had not been; files of checkpoints."""

import errno
import io
import os
import pickle
import subprocess
import sys
import textwrap
import threading
import zipfile
from types import ModuleType

import gymnasium
import pytest
from filelock import FileLock

from gpadjust.control import EpisodeCheckpoint, MPCAgent, PolicySearchAgent, resume
from gpadjust.control.episodes import generators, set_generators
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from tests.control.conftest import PLAN, described
from tests.point import (
    PowerCut,
    Shouting,
    assert_equal,
    forbid_unpickling,
    robot,
    scramble,
)

pytestmark = pytest.mark.filterwarnings("ignore:A step of the last real episode")
TOTAL = 15  # three episodes of the point


def cut_at(step):
    """A callback that interrupts the run."""

    def callback(agent, event, values):
        if event == "step" and agent.num_timesteps == step:
            raise PowerCut

    return callback


def numbers(agent):
    """All that an agent has learnt, and what its generators draw next."""
    episodes = agent.recorded_episodes()
    return {
        "episodes": [episodes.states, episodes.actions, episodes.rewards, episodes.episode],
        "dynamics": agent.task.dynamics.state_dict(),
        "learnt": described(agent).learnt(agent),
        "counts": [agent.num_timesteps, agent.num_episodes, agent.promised_reward, agent.notes],
        "random": generators(),
    }


@pytest.fixture
def again(make_agent, point_env):
    """Makes environment and task of a run once more."""
    return lambda kind=MPCAgent, **given: (point_env(), make_agent(kind, **given).task)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [(7,), pytest.param((3, 11, 12), marks=pytest.mark.slow)])
def test_an_interrupted_run_ends_as_another(make_agent, kind, steps, again, tmp_path):
    path = tmp_path / "run.ckpt"
    whole = numbers(make_agent(kind).learn(TOTAL))
    agent = make_agent(kind)
    for step in steps:
        with pytest.raises(PowerCut):
            agent.learn(TOTAL - agent.num_timesteps, [EpisodeCheckpoint(path), cut_at(step)])
        given = again(kind)
        scramble()
        agent = resume(path, *given)
        assert type(agent) is kind
        assert agent.num_timesteps == step // 5 * 5
        scramble()
    agent.learn(TOTAL - agent.num_timesteps, EpisodeCheckpoint(path))
    assert_equal(numbers(agent), whole)
    given = again(kind)
    last = numbers(resume(path, *given))
    for part in ("episodes", "dynamics", "learnt", "counts"):
        assert_equal(last[part], whole[part])


def test_checkpoints_come_every_so_many_episodes(make_agent, tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(
        EpisodeCheckpoint, "_write", lambda self, agent: saved.append(agent.num_timesteps)
    )
    make_agent(MPCAgent).learn(15, EpisodeCheckpoint(tmp_path / "run.ckpt", every=2))
    assert saved == [0, 10, 10, 15]


# Files


@pytest.mark.slow
def test_a_full_disk_leaves_the_file_before_it_and_the_run_goes_on(
    make_agent, again, tmp_path, monkeypatch
):
    """At any byte of the file; the agent has lost nothing, nor has who resumes."""
    path = tmp_path / "run.ckpt"
    whole = numbers(make_agent(MPCAgent).learn(TOTAL))
    agent = make_agent(MPCAgent).learn(5)
    agent.save(path)
    before = path.read_bytes()
    for room in (0, len(before) // 2, len(before) - 1):
        with monkeypatch.context() as patch:
            patch.setattr("builtins.open", lambda *given, room=room: SmallDisk(*given, room=room))
            with pytest.raises(OSError, match=r"No space left on device") as full:
                agent.learn(5, EpisodeCheckpoint(path))
        assert "the agent has lost nothing" in full.value.__notes__[0]
        assert agent.num_timesteps == 5
        assert path.read_bytes() == before
        assert {*tmp_path.iterdir()} == {path, path.with_name("run.ckpt.lock")}
    resumed = resume(path, *again())
    for each in (agent, resumed):
        set_generators(pickle.loads(zipfile.ZipFile(path).read("run.pkl"))[2])
        assert_equal(numbers(each.learn(10, EpisodeCheckpoint(path))), whole)


class SmallDisk(io.FileIO):
    """A file on a disk that has room for so many bytes."""

    def __init__(self, *given, room):
        super().__init__(*given)
        self.room = room

    def write(self, content):
        if self.tell() + len(content) > self.room:
            super().write(content[: max(self.room - self.tell(), 0)])
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(content)


def test_what_a_killed_writer_left_does_not_pile_up(make_agent, tmp_path):
    path = tmp_path / "run.ckpt"
    (tmp_path / ".run.ckpt.part").write_bytes(b"half of it")
    make_agent(MPCAgent).save(path)
    assert {*tmp_path.iterdir()} == {path, path.with_name("run.ckpt.lock")}


@pytest.mark.skipif(os.name != "posix", reason="links need rights there")
def test_a_link_at_the_name_of_the_part_is_not_followed(make_agent, tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / ".run.ckpt.part").symlink_to(victim)
    make_agent(MPCAgent).save(tmp_path / "run.ckpt")
    assert victim.read_text() == "precious"
    assert not (tmp_path / "run.ckpt").is_symlink()


@pytest.mark.skipif(os.name != "posix", reason="folders cannot be synchronised there")
def test_the_name_of_a_checkpoint_is_on_the_disk(make_agent, tmp_path, monkeypatch):
    """After the file itself, its folder is synchronised, or a power cut could lose the new name."""
    synced, agent = [], make_agent(MPCAgent).learn(5)
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    agent.save(tmp_path / "run.ckpt")
    assert synced == [(tmp_path / "run.ckpt").stat().st_ino, tmp_path.stat().st_ino]


@pytest.mark.parametrize("kept", [lambda agent: agent.task, lambda agent: [agent.task.dynamics]])
def test_code_of_the_users_is_in_no_checkpoint(make_agent, kept, tmp_path):
    agent = make_agent(MPCAgent)
    agent.kept = kept(agent)
    with pytest.raises(TypeError, match=r"MPCAgent.kept .* neither tasks nor .* in not_saved"):
        agent.save(tmp_path / "run.ckpt")
    assert {*tmp_path.iterdir()} == {tmp_path / "run.ckpt.lock"}


class Broken:
    """What fails as it is unpickled."""

    def __getstate__(self):
        return {"name": 1}

    def __setstate__(self, state):
        state["missing"]


def test_an_error_of_the_users_own_is_not_that_of_another_file(make_agent, again, tmp_path):
    agent = make_agent(MPCAgent)
    agent.notes["broken"] = Broken()
    agent.save(tmp_path / "run.ckpt")
    with pytest.raises(KeyError, match="missing"):
        resume(tmp_path / "run.ckpt", *again())


class Planning(MPCAgent):
    """One that keeps what holds a task, which it makes again where it is missing."""

    not_saved = ("planning",)

    def improve(self, task):
        self.planning = self.mpc
        return True

    def predict(self, *given):
        if not hasattr(self, "planning"):
            self.planning = self.mpc
        return self.planning.predict(*given)


def test_a_subclass_names_only_what_it_adds_to_not_saved(make_agent, again, tmp_path):
    path = tmp_path / "run.ckpt"
    options = {"each_step": PLAN, "first": PLAN}
    whole = make_agent(Planning, **options).learn(10).recorded_episodes()
    make_agent(Planning, **options).learn(5).save(path)
    agent = resume(path, *again())
    assert not hasattr(agent, "planning")
    assert_equal([agent.learn(5).recorded_episodes().states], [whole.states])


def test_an_attribute_that_cannot_be_pickled_is_named(make_agent, tmp_path):
    agent = make_agent(MPCAgent)
    agent.camera = threading.Lock()
    with pytest.raises(TypeError, match=r"MPCAgent.camera cannot be pickled.*not_saved"):
        agent.save(tmp_path / "run.ckpt")
    assert not (tmp_path / "run.ckpt").exists()


def test_of_a_class_that_is_defined_twice_the_newest_is_resumed(
    make_agent, again, tmp_path, monkeypatch
):
    notebook = ModuleType("notebook")

    def define():
        notebook.CellAgent = type("CellAgent", (MPCAgent,), {"__module__": "notebook"})
        return notebook.CellAgent

    path, first = tmp_path / "new" / "run.ckpt", define()  # the folder is made
    make_agent(first, each_step=None, first=None).save(path)
    with pytest.raises(ValueError, match="class notebook:CellAgent, which is not imported"):
        resume(path, *again())
    monkeypatch.setitem(sys.modules, "notebook", notebook)
    assert type(resume(path, *again())) is first
    second = define()
    assert type(resume(path, *again())) is second
    assert type(resume(path, *again(), second)) is second


def test_other_files_are_refused(make_agent, again, tmp_path):
    whole, cut, other = (tmp_path / name for name in ("whole", "cut", "other"))
    make_agent(MPCAgent).learn(5).save(whole)
    cut.write_bytes(whole.read_bytes()[:-2000])
    other.write_bytes(pickle.dumps([1]))
    flipped = bytearray(whole.read_bytes())
    flipped[len(flipped) // 2] ^= 0xFF
    (tmp_path / "flipped").write_bytes(flipped)
    with zipfile.ZipFile(whole) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    for missing in parts:
        with zipfile.ZipFile(tmp_path / missing, "w") as archive:
            for name in {*parts} - {missing}:
                archive.writestr(name, parts[name])
    for path in (cut, other, tmp_path / "flipped", *(tmp_path / name for name in parts)):
        with pytest.raises(ValueError, match=f"{path.name} is not a checkpoint of"):
            resume(path, *again())
    with pytest.raises(FileNotFoundError):
        resume(tmp_path / "none", *again())


def test_an_environment_that_cannot_be_pickled_is_reset(make_agent, point_env, again, tmp_path):
    path = tmp_path / "run.ckpt"
    with (
        pytest.warns(UserWarning, match="environment cannot be pickled"),
        pytest.raises(PowerCut),
    ):
        make_agent(MPCAgent, robot(point_env())).learn(TOTAL, [EpisodeCheckpoint(path), cut_at(13)])
    agent = resume(path, robot(point_env()), again()[1])
    assert agent.num_timesteps == 10
    assert len(agent.learn(5).recorded_episodes()) == TOTAL


def test_what_does_not_fit_is_refused_before_anything_is_unpickled(
    make_agent, again, tmp_path, monkeypatch
):
    path = tmp_path / "run.ckpt"
    make_agent(MPCAgent).learn(5).save(path)

    forbid_unpickling(monkeypatch)
    env, task = again()
    wide = again()[0]
    wide.action_space = gymnasium.spaces.Box(-3, 3, (1,))
    own = "of another run: "
    for given, message in [
        (
            (Shouting(env), task),
            f"{own}environment is .*TimeLimit of Point .*, StepGuard of Shouting",
        ),
        ((wide, task), rf"{own}action_space is Box\(-2"),
        ((env, task, PolicySearchAgent), "agent is .*:MPCAgent in .*:PolicySearchAgent here"),
        ((env, again(episode_length=9)[1]), "episode_length is 5 .*, 9 here"),
        ((env, again(initial_states=None)[1]), "initial_states is True .*, False here"),
    ]:
        with pytest.raises(ValueError, match=message):
            resume(path, *given)
    with pytest.raises(TypeError, match="task must be a Task"):
        resume(path, env, task.dynamics)


@pytest.mark.parametrize("learns", [True, False])
def test_another_physics_is_refused(make_agent, point_dynamics, again, learns, tmp_path):
    kind = LearnedDynamics if learns else PhysicsDynamics

    def known(slope):
        return {"dynamics": kind(point_dynamics.spec, lambda X: X[:, :1] + slope * X[:, 1:])}

    make_agent(MPCAgent, **known(0.4)).learn(5).save(tmp_path / "run.ckpt")
    with pytest.raises(RuntimeError, match="physics"):
        resume(tmp_path / "run.ckpt", *again(**known(0.41)))


OTHER = """
    import sys

    from filelock import FileLock

    lock = FileLock(sys.argv[1] + ".lock").acquire()
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_two_processes_do_not_write_one_file(make_agent, tmp_path):
    path = tmp_path / "run.ckpt"
    command = [sys.executable, "-c", textwrap.dedent(OTHER), str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as other:
        assert other.stdout.readline() == "locked\n"
        agent = make_agent(MPCAgent)
        for write in (lambda: agent.learn(5, EpisodeCheckpoint(path)), lambda: agent.save(path)):
            with pytest.raises(RuntimeError, match=r"Another run writes .*run.ckpt"):
                write()
        assert agent.num_timesteps == 0
        other.kill()  # which releases it
    agent.learn(5, EpisodeCheckpoint(path))
    assert path.exists()


def test_a_lock_is_released_after_an_error_and_held_by_one_run(make_agent, tmp_path):
    path = tmp_path / "run.ckpt"
    checkpoint = EpisodeCheckpoint(path)
    with pytest.raises(PowerCut):
        make_agent(MPCAgent).learn(10, [checkpoint, cut_at(3)])
    lock = FileLock(f"{path}.lock")
    lock.acquire(blocking=False)
    lock.release()
    other = make_agent(MPCAgent, seed=1)

    def writes_too(agent, event, values):
        with pytest.raises(RuntimeError, match="Another run writes"):
            other.save(path)

    make_agent(MPCAgent).learn(5, [checkpoint, writes_too])
    lock.acquire(blocking=False)
    lock.release()


@pytest.mark.slow
def test_a_refused_call_does_not_spend_the_generators(make_agent, again, tmp_path):
    path = tmp_path / "run.ckpt"
    whole = numbers(make_agent(MPCAgent).learn(TOTAL))
    with pytest.raises(PowerCut):
        make_agent(MPCAgent).learn(TOTAL, [EpisodeCheckpoint(path), cut_at(13)])
    agent = resume(path, *again())
    with FileLock(f"{path}.lock"), pytest.raises(RuntimeError, match="Another run writes"):
        agent.learn(5, EpisodeCheckpoint(path))
    scramble()
    assert_equal(numbers(agent.learn(5, EpisodeCheckpoint(path))), whole)


def test_what_was_resumed_is_saved_again_as_it_was(make_agent, again, tmp_path):
    first, second = tmp_path / "first.ckpt", tmp_path / "second.ckpt"
    agent = make_agent(MPCAgent)
    agent.notes["costs"] = [1.0]
    agent.learn(5).save(first)
    expected = numbers(agent.learn(5))
    given = again()
    scramble()
    resume(first, *given).save(second)
    resumed = resume(second, *again())
    scramble()
    assert_equal(numbers(resumed.learn(5)), expected)
    assert expected["counts"][-1] == {"costs": [1.0]}
