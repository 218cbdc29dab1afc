"""A MuJoCo model as physics: its control step, and its sensors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.checks import check_kind, checked_number, checked_tensor, checked_whole
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.mujoco_parameters import Edit, ModelParameters, names_of, silenced
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown
from gpadjust.states import Sensors, StateSpec

Array = NDArray[np.float64]

_AT_ONCE = 50_000  # simulation steps, after which Ctrl-C is heard
_WORTH = 500  # simulation steps that make up for the start of a thread


class MujocoPhysics(BlackBoxPhysics):
    r"""One control step of a MuJoCo model, which is one or more of its simulation steps.

    A row is the state, ``qpos``, ``qvel`` and ``act``, and the action, which is held during the
    step; the outputs are the next state. :attr:`spec` names their entries: of a joint "hinge"
    ``hinge`` and ``hinge_dot``, of the activation of an actuator "motor" ``motor_act``. Rows run in
    threads, and do not depend on each other: the solver of constraints begins each at zero.
    Gradients are central differences, as of :class:`BlackBoxPhysics`.

    Names of unknown parameters are ``"element.parameter"``, in the units of the MJCF:

    - body: ``mass``, with the inertia in proportion; ``com_x, com_y, com_z``, the center of mass;
      ``stretch_x, stretch_y, stretch_z, shear_xy, shear_xz, shear_yz``, which deform the mass about
      its center, along the body's axes, and leave its amount and the geoms: 1 and 0 are the inertia
      of the MJCF. Second moments S of the mass become

      .. math:: A S A^\top, \quad A = \begin{pmatrix} \text{stretch}_x & \text{shear}_{xy} &
          \text{shear}_{xz} \\ & \text{stretch}_y & \text{shear}_{yz} \\ & & \text{stretch}_z
          \end{pmatrix},

      so that any numbers are of an inertia that a body can have (Rucker and Wensing 2022);
    - joint, tendon: ``damping, frictionloss, armature, stiffness``;
    - actuator: ``gear``; of a position or velocity servo ``kp, kv``; geom: ``friction`` (sliding);
    - all others are read by ``edit``.

    Args:
        model: The path of an MJCF or URDF file, an MJCF text, a ``mujoco.MjSpec`` or a
            ``mujoco.MjModel``. A pickle holds a path, not the file.
        step: The control step in s, a multiple of the model's time step. Default: that one.
        unknowns: The unknown parameters, such as ``{"link1.mass": Unknown(1.0, factor=1.5)}``.
        edit: A function that changes an ``MjSpec``, its first argument, by the values of the
            parameters, ``p["pole.length"]``. The result is compiled for each value.
        actions: The names of the actuators that the action drives, in its order; others get zero.
            Default: all.
        threads: The most threads. Default: as many as PyTorch has.
        name: As of :class:`Physics`.

    Raises:
        ImportError: Without MuJoCo 3.5 or newer.
        TypeError: If the model is something else.
        ValueError: If the model cannot be read, has a ball or free joint, or a state besides
            ``qpos``, ``qvel`` and ``act``, or an argument does not fit it.
        PhysicsError: When called, if the simulation is unstable; it names the rows.

    Example:
        >>> pendulum = MujocoPhysics('''<mujoco><worldbody><body name="rod">
        ...     <joint name="hinge" axis="0 1 0"/>
        ...     <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.02" mass="1"/>
        ... </body></worldbody><actuator><motor name="torque" joint="hinge"/></actuator>
        ... </mujoco>''', step=0.02, unknowns={"hinge.damping": Unknown(0.1, factor=2.0)})
        >>> pendulum.spec.states, pendulum.spec.actions, pendulum.spec.angles
        (('hinge', 'hinge_dot'), ('torque',), ('hinge',))
        >>> pendulum(torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64))
        tensor([[0.0199, 0.9915]], dtype=torch.float64)
    """

    advice = "If it comes from edit, correct that."

    def __init__(
        self,
        model: Any,
        *,
        step: float | None = None,
        unknowns: Mapping[str, Unknown] | None = None,
        edit: Edit | None = None,
        actions: Sequence[str] | None = None,
        threads: int | None = None,
        name: str | None = None,
    ) -> None:
        mujoco = _mujoco()
        super().__init__(self._next_states, unknowns=unknowns, name=name or "MuJoCo model")
        kinds = str | Path | mujoco.MjSpec | mujoco.MjModel
        check_kind("model", model, kinds, "the path of an MJCF, its text, an MjSpec or an MjModel")
        # Copies, as the caller may change an MjModel or an MjSpec later.
        self.source = model.copy() if isinstance(model, mujoco.MjSpec) else copy(model)
        if isinstance(model, Path | str) and not str(model).lstrip().startswith("<"):
            self.source = Path(model).absolute()
        spec = None
        self.model = self.source
        if not isinstance(model, mujoco.MjModel):
            spec = partial(_read, self.source)
            self.model = _compiled(self.source)
        self.states = tuple(_state_names(self.model))
        self.num_outputs = len(self.states)
        self.unknowns.refuse_functions()
        self._models = ModelParameters(self.model, spec, self.unknowns, edit)
        actuators = names_of(self.model, "actuator")
        controls = getattr(self.model, "actuator_ctrlnum", np.ones(len(actuators), int))
        drives = _parts(actuators, controls, "actuator")
        if actions is None:
            actions = drives
        self.actions = tuple(actions)
        for action in self.actions:
            if action not in drives:
                raise ValueError(f"There is no actuator {action!r}; expected some of {drives}.")
        self._driven = [drives.index(action) for action in self.actions]
        length = float(self.model.opt.timestep)
        self.step = length
        if step is not None:
            self.step = checked_number("step", step, above=0)
        self.num_steps = round(self.step / length)
        if self.num_steps < 1 or abs(self.step / length - self.num_steps) > 1e-6:
            raise ValueError(f"step must be a multiple of the model's {length:g} s; found {step}.")
        self.threads = None if threads is None else checked_whole("threads", threads, 1)
        self._data: list[Any] = []

    @property
    def spec(self) -> StateSpec:
        """Names of states and actions; a hinge without limits is an angle.

        Raises:
            ValueError: If there is no actuator.
        """
        if not self.actions:
            raise ValueError(
                "The model has no actuator, and a StateSpec has an action: add a <motor> to the "
                "MJCF, and let its action be zero."
            )
        # A hinge that turns all around has the same state after a turn.
        is_hinge = self.model.jnt_type == int(_mujoco().mjtJoint.mjJNT_HINGE)
        is_angle = is_hinge & (self.model.jnt_limited == 0)
        angles = [name for name, turns in zip(self.states, is_angle, strict=False) if turns]
        return StateSpec(self.states, self.actions, angles=angles, step=self.step)

    def mj_model(self, parameters: Tensor | None = None) -> Any:
        """Return a ``mujoco.MjModel`` with these values of the parameters, ``p``, or the guesses.

        It is for viewers, environments and ``mujoco.mj_saveModel``.

        Raises:
            ValueError: If it is another number of values.
        """
        guess = values = self.unknowns.guess
        if parameters is not None:
            values = checked_tensor("parameters", parameters)
        if values.shape != guess.shape:
            raise ValueError(
                f"parameters: expected a value of each of {', '.join(self.unknowns) or 'none'}, of "
                f"shape {tuple(guess.shape)}; found {tuple(values.shape)}."
            )
        return copy(self._models.compiled(values.numpy()))

    def sensors(self, names: Sequence[str] | None = None) -> Sensors:
        """Return sensors of the model as outputs of the state, with parameters at their guesses.

        The noise of the MJCF is the guess of their noise.

        Args:
            names: The names of the sensors. Default: all that states determine.

        Raises:
            ValueError: If there is no sensor of a name, or it depends on the action, as those of
                accelerations and forces do.
        """
        with_forces = int(_mujoco().mjtStage.mjSTAGE_ACC)
        all_names = names_of(self.model, "sensor")
        stages = self.model.sensor_needstage
        of_states = [name for name, s in zip(all_names, stages, strict=True) if s < with_forces]
        if names is None:
            names = of_states
        for name in names:
            if name not in of_states:
                raise ValueError(
                    f"Expected sensors of positions or velocities, {of_states}; found {name!r}."
                )
        sensors = [self.model.sensor(name) for name in names]
        sizes = [sensor.dim[0] for sensor in sensors]
        columns = [k for s in sensors for k in range(s.adr[0], s.adr[0] + s.dim[0])]
        outputs = _parts(names, sizes, "sensor")
        sd = np.repeat([float(sensor.noise[0]) for sensor in sensors], sizes).tolist()
        noise = {output: value for output, value in zip(outputs, sd, strict=True) if value > 0}
        measure = BlackBoxPhysics(partial(self._measured, columns), name="sensors")
        return Sensors(outputs, measure, noise=noise)

    def __getstate__(self) -> dict[str, Any]:
        if isinstance(self.source, _mujoco().MjSpec):
            raise TypeError(
                "A physics of an MjSpec cannot be pickled; make it of a path, of a text such as "
                "spec.to_xml(), which has six digits, or of the MjModel spec.compile()."
            )
        return {**self.__dict__, "_data": []}

    def _next_states(self, rows: Array, *parameters: ParameterValues) -> Array:
        """Return the states ``N x d`` after a control step, of rows and parameters."""
        d = len(self.states)
        if rows.shape[1] != d + len(self.actions):
            raise ValueError(
                f"expected the states {self.states} and the actions {self.actions}, found "
                f"{rows.shape[1]} column(s)"
            )
        values = parameters[0].rows if parameters else np.empty((len(rows), 0))
        # Rows of the same parameters share a compiled model.
        distinct, number = np.unique(values, axis=0, return_inverse=True)
        compiled = [self._models.compiled(value) for value in distinct]
        models = [compiled[i] for i in number.ravel()]
        following, _ = self._simulated(models, rows[:, :d], rows[:, d:], self.num_steps)
        unstable = np.flatnonzero(np.isnan(following).any(1)).tolist()
        if unstable:
            raise PhysicsError(
                f"The simulation of physics {self.name!r} is unstable (NaN, infinite or huge "
                f"numbers) in {len(unstable)} of {len(rows)} row(s). Make the time step of the "
                "MJCF shorter, narrow the priors, or exclude such inputs:",
                unstable,
                partial=torch.from_numpy(following),
            )
        return following

    def _measured(self, columns: Sequence[int], states: Array) -> Array:
        """Return the readings of sensors at states ``N x d``."""
        models = [self.mj_model()] * len(states)
        actions = np.zeros((len(states), len(self.actions)))
        # Sensors of a simulation step are those of its beginning.
        return self._simulated(models, states, actions, 1)[1][:, columns]

    def _simulated(
        self, models: Sequence[Any], states: Array, actions: Array, num_steps: int
    ) -> tuple[Array, Array]:
        """Return states after simulation steps, NaN if unstable, and sensors before the last."""
        from mujoco import MjData
        from mujoco.rollout import Rollout

        n = len(states)
        length = self.model.opt.timestep
        controls = np.zeros((n, 1, self.model.nu))
        controls[:, 0, self._driven] = actions
        # MuJoCo resets an unstable simulation to time 0, at any step.
        starts = np.column_stack([np.full(n, length), states])
        ends = np.empty_like(starts)
        sensors = np.empty((n, self.model.nsensordata))
        threads = self.threads or torch.get_num_threads()
        threads = min(threads, 1 + n * num_steps // _WORTH)
        pool = Rollout(nthread=threads if threads > 1 else 0)
        # Rows in a call of the pool, which Ctrl-C cannot end.
        at_once = max(1, _AT_ONCE // num_steps)
        with silenced(), pool:
            self._data += [MjData(self.model) for _ in range(threads - len(self._data))]
            for first in range(0, n, at_once):
                part = slice(first, first + at_once)
                path, readings = pool.rollout(
                    *(models[part], self._data[:threads], starts[part], controls[part]),
                    nstep=num_steps,
                )
                ends[part], sensors[part] = path[:, -1], readings[:, -1]
        # Time began at one step, and would have counted all of them.
        ends[ends[:, 0] < (num_steps + 0.5) * length] = np.nan
        return ends[:, 1:], sensors


def _mujoco() -> Any:
    """Return the module, or raise an ImportError that names the extra."""
    try:
        import mujoco
        import mujoco.rollout
    except ImportError as error:
        raise ImportError(
            'MujocoPhysics needs MuJoCo; run `pip install "gpadjust[mujoco]"`.'
        ) from error
    return mujoco


def _read(source: Any) -> Any:
    """Return a new MjSpec."""
    spec = _mujoco().MjSpec
    if isinstance(source, Path):
        return spec.from_file(str(source))
    return spec.from_string(source) if isinstance(source, str) else source.copy()


def _compiled(source: Any) -> Any:
    """Return the compiled model."""
    try:
        with silenced():
            return _read(source).compile()
    except Exception as error:  # of the parser and of the compiler
        raise ValueError(f"MuJoCo cannot read the model: {described(error)}.") from error


def _parts(names: Sequence[str], sizes: Iterable[int], kind: str) -> list[str]:
    """Return names of all numbers of elements, by the number of the element if it has no name."""
    parts = []
    for i, (name, size) in enumerate(zip(names, sizes, strict=True)):
        name = name or f"{kind}{i}"
        parts += [name] if size == 1 else [f"{name}_{k}" for k in range(size)]
    return parts


def _state_names(model: Any) -> list[str]:
    """Return names of the entries of the state, or raise a ValueError if it has others."""
    mujoco = _mujoco()
    joints = _parts(names_of(model, "joint"), np.ones(model.njnt, int), "joint")
    for name, kind in zip(joints, model.jnt_type, strict=True):
        if kind in map(int, (mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_FREE)):
            raise ValueError(
                f"Joint {name!r} is a ball or free joint, whose quaternions lie on a sphere and "
                "are no entries of a state: put hinges, and slides, into its body instead."
            )
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    if size != 1 + model.nq + model.nv + model.na:
        raise ValueError(
            "The model has a state besides qpos, qvel and act, of a plugin or a delay. Remove it; "
            "of actions that act late see StateSpec(previous=...)."
        )
    activations = _parts(names_of(model, "actuator"), model.actuator_actnum, "actuator")
    return [*joints, *(f"{j}_dot" for j in joints), *(f"{a}_act" for a in activations)]
