"""Runs of agents that are interrupted, and go on as if they had not been; files of checkpoints."""

import errno
import io
import os
import pickle
import sys
import threading
import zipfile
from types import ModuleType

import gymnasium
import pytest
from filelock import FileLock

from gpadjust.control import EpisodeCheckpoint, MPCAgent, PolicySearchAgent, resume
from gpadjust.control.episodes import generators, set_generators
from gpadjust.dynamics import PhysicsDynamics
from tests.control.conftest import PLAN, described
from tests.point import (
    POINT_SPEC,
    PowerCut,
    Shouting,
    assert_equal,
    forbid_unpickling,
    robot,
    scramble,
)
from tests.systems import refused

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


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.ckpt"


@pytest.mark.slow
def test_an_interrupted_run_ends_as_another(make_agent, kind, again, path):
    whole = numbers(make_agent(kind).learn(TOTAL))
    agent = make_agent(kind)
    for step in (3, 7, 12):
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


def test_what_was_resumed_is_saved_again_as_it_was(make_agent, again, path):
    """Nor does a call that a lock refuses spend the generators."""
    agent = make_agent(MPCAgent)
    agent.notes["costs"] = [1.0]
    agent.learn(5).save(path)
    expected = numbers(agent.learn(5))
    second = path.with_name("second.ckpt")
    resume(path, *again()).save(second)
    resumed = resume(second, *again())
    with FileLock(f"{path}.lock"), pytest.raises(RuntimeError, match="Another run writes"):
        resumed.learn(5, EpisodeCheckpoint(path))
    scramble()
    assert_equal(numbers(resumed.learn(5, EpisodeCheckpoint(path))), expected)
    assert expected["counts"][-1] == {"costs": [1.0]}


def test_checkpoints_come_before_and_after_each_episode(make_agent, path, monkeypatch):
    saved = []
    monkeypatch.setattr(
        EpisodeCheckpoint, "_write", lambda self, agent: saved.append(agent.num_timesteps)
    )
    make_agent(MPCAgent).learn(10, EpisodeCheckpoint(path))
    assert saved == [0, 5, 5, 10, 10]


def test_an_environment_that_cannot_be_pickled_is_reset(make_agent, point_env, again, path):
    agent = make_agent(MPCAgent, robot(point_env()))
    with pytest.warns(UserWarning, match="environment cannot be pickled"), pytest.raises(PowerCut):
        agent.learn(TOTAL, [EpisodeCheckpoint(path), cut_at(8)])
    agent = resume(path, robot(point_env()), again()[1])
    assert agent.num_timesteps == 5
    assert len(agent.learn(5).recorded_episodes()) == 10


# Files


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


@pytest.mark.slow
def test_a_full_disk_leaves_the_file_before_it_and_the_run_goes_on(
    make_agent, again, path, monkeypatch
):
    """At any byte of the file."""
    whole = numbers(make_agent(MPCAgent).learn(10))
    agent = make_agent(MPCAgent).learn(5)
    agent.save(path)
    before = path.read_bytes()
    for room in (0, len(before) // 2, len(before) - 1):
        with monkeypatch.context() as patch:
            patch.setattr("builtins.open", lambda *given, room=room: SmallDisk(*given, room=room))
            with pytest.raises(OSError, match=r"No space left on device") as full:
                agent.learn(5, EpisodeCheckpoint(path))
        assert "the agent has lost nothing" in full.value.__notes__[0]
        assert path.read_bytes() == before
        assert {*path.parent.iterdir()} == {path, path.with_name("run.ckpt.lock")}
    resumed = resume(path, *again())
    for each in (agent, resumed):
        set_generators(pickle.loads(zipfile.ZipFile(path).read("run.pkl"))[2])
        assert_equal(numbers(each.learn(5, EpisodeCheckpoint(path))), whole)


@pytest.mark.skipif(os.name != "posix", reason="links and folders are other ones there")
def test_a_file_takes_the_place_of_what_a_killed_writer_left(make_agent, path, monkeypatch):
    """A link is not followed; and after the file its folder is synchronised, for its new name."""
    victim, part = path.with_name("victim"), path.with_name(".run.ckpt.part")
    victim.write_text("precious")
    part.symlink_to(victim)
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    make_agent(MPCAgent).save(path)
    assert victim.read_text() == "precious"
    assert not path.is_symlink()
    assert not part.exists()
    assert synced == [path.stat().st_ino, path.parent.stat().st_ino]


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (lambda agent: agent.task, "neither tasks nor .* in not_saved"),
        (lambda agent: [agent.task.dynamics], "neither tasks nor .* in not_saved"),
        (lambda agent: threading.Lock(), "pickled.*not_saved"),
    ],
)
def test_an_attribute_that_cannot_be_saved_is_named(make_agent, kept, words, path):
    agent = make_agent(MPCAgent)
    agent.kept = kept(agent)
    with pytest.raises(TypeError, match=f"MPCAgent.kept cannot be .*{words}"):
        agent.save(path)
    assert not path.exists()


class Broken:
    """What fails as it is unpickled."""

    def __getstate__(self):
        return {"name": 1}

    def __setstate__(self, state):
        state["missing"]


def test_an_error_of_the_users_own_is_not_that_of_another_file(make_agent, again, path):
    agent = make_agent(MPCAgent)
    agent.notes["broken"] = Broken()
    agent.save(path)
    with pytest.raises(KeyError, match="missing"):
        resume(path, *again())


class Planning(MPCAgent):
    """One that keeps what holds a task, which it makes again where it is missing."""

    not_saved = ("planning",)

    def predict(self, *given):
        self.planning = getattr(self, "planning", self.mpc)
        return super().predict(*given)


def test_a_subclass_names_only_what_it_adds_to_not_saved(make_agent, again, path):
    make_agent(Planning, each_step=PLAN, first=PLAN).learn(5).save(path)
    agent = resume(path, *again())
    assert not hasattr(agent, "planning")
    assert agent.learn(5).num_episodes == 2


def test_of_a_class_that_is_defined_twice_the_newest_is_resumed(
    make_agent, again, tmp_path, monkeypatch
):
    notebook = ModuleType("notebook")

    def define():
        notebook.CellAgent = type("CellAgent", (MPCAgent,), {"__module__": "notebook"})
        return notebook.CellAgent

    path = tmp_path / "new" / "run.ckpt"  # the folder is made
    make_agent(define()).save(path)
    with pytest.raises(ValueError, match="class notebook:CellAgent, which is not imported"):
        resume(path, *again())
    monkeypatch.setitem(sys.modules, "notebook", notebook)
    second = define()
    assert type(resume(path, *again())) is second
    assert type(resume(path, *again(), second)) is second


def test_other_files_are_refused(make_agent, again, tmp_path):
    whole = tmp_path / "whole"
    make_agent(MPCAgent).learn(5).save(whole)
    content = whole.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 0xFF
    files = {"cut": content[:-2000], "other": pickle.dumps([1]), "flipped": flipped}
    for name, damaged in files.items():
        (tmp_path / name).write_bytes(damaged)
    with zipfile.ZipFile(whole) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    for name, part in parts.items():
        with zipfile.ZipFile(tmp_path / f"only {name}", "w") as archive:
            archive.writestr(name, part)
    for name in (*files, *(f"only {name}" for name in parts)):
        with pytest.raises(ValueError, match=f"{name} is not a checkpoint of"):
            resume(tmp_path / name, *again())
    with pytest.raises(FileNotFoundError):
        resume(tmp_path / "none", *again())


def test_what_does_not_fit_is_refused_before_anything_is_unpickled(
    make_agent, again, path, monkeypatch
):
    make_agent(MPCAgent).learn(5).save(path)
    forbid_unpickling(monkeypatch)
    env, task = again()
    wide = again()[0]
    wide.action_space = gymnasium.spaces.Box(-3, 3, (1,))
    shouting = "of another run: environment is .*TimeLimit of Point .*, StepGuard of Shouting"
    for given, words in [
        ((Shouting(env), task), shouting),
        ((wide, task), r"action_space is Box\(-2"),
        ((env, task, PolicySearchAgent), "agent is .*:MPCAgent in .*:PolicySearchAgent here"),
        ((env, again(episode_length=9)[1]), "episode_length is 5 .*, 9 here"),
        ((env, again(initial_states=None)[1]), "initial_states is True .*, False here"),
    ]:
        refused(ValueError, words, resume, path, *given)
    refused(TypeError, "task must be a Task", resume, path, env, task.dynamics)


def test_another_physics_is_refused(make_agent, again, path):
    def other(slope):
        return {"dynamics": PhysicsDynamics(POINT_SPEC, lambda X: X[:, :1] + slope * X[:, 1:])}

    make_agent(MPCAgent, **other(0.4)).learn(5).save(path)
    with pytest.raises(RuntimeError, match="physics"):
        resume(path, *again(**other(0.41)))


def test_a_lock_is_released_after_an_error_and_held_by_one_run(make_agent, path):
    checkpoint = EpisodeCheckpoint(path)
    with pytest.raises(PowerCut):
        make_agent(MPCAgent).learn(10, [checkpoint, cut_at(3)])
    other = make_agent(MPCAgent, seed=1)

    def writes_too(agent, event, values):
        with pytest.raises(RuntimeError, match=r"Another run writes .*run.ckpt"):
            other.save(path)

    make_agent(MPCAgent).learn(5, [checkpoint, writes_too])
    FileLock(f"{path}.lock").acquire(blocking=False).lock.release()
