"""Options that several commands share, each stated once."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True)
class RobotOptions:
    """The robot to train."""

    robot: str = "cartpole"
    """Built-in robot: cartpole, ant, ballbalance or go2."""
    option: tuple[str, ...] = ()
    """Options of the built-in robot, NAME=VALUE. go2: parameters=default, real (without
    friction) or full (25 in place of 8), torque_speed=true, rewarded=gait or command,
    forward=LOW:HIGH [m/s], episode_length=STEPS; ballbalance: episode_length=STEPS."""
    env: Path | None = None
    """An environment of your own, a Python file, in place of --robot (template:
    examples/my_robot/env.py)."""


@dataclasses.dataclass(frozen=True)
class EngineOptions:
    """What simulates."""

    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """mjx: compiled, on CPU or accelerator. mujoco: native MuJoCo on all cores, which
    compiles nothing and simulates nearly every model. auto: mjx on an accelerator and
    for small robots, else mujoco; the command says which (docs/engines.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnEffectsOptions:
    """Effects that the user wrote."""

    effects_from: tuple[Path, ...] = ()
    """Python files with effects of your own (template:
    examples/own_effects/coupling_spring.py), which join those that are known. They are
    run."""


@dataclasses.dataclass(frozen=True)
class TargetOptions(OwnEffectsOptions):
    """The pseudo-real robot, and what it has that the model lacks."""

    target: tuple[str, ...] | None = None
    """The pseudo-real robot: parameters that differ from the nominal ones, as
    NAME*FACTOR or NAME=VALUE; not given: cart_kp*0.5 (cartpole), torso_mass*0.5 (ant),
    ball_mass*0.5 (ballbalance), thigh_kp*0.5 (go2)."""
    effects: Path | None = None
    """Effects that the model lacks (effects.yaml of train.gap): the robot gets them,
    and their parameters vary with the others."""
    target_effects: Path | None = None
    """An effects file for the pseudo-real robot alone: it has these effects whether
    --effects names them or not (without --target, nothing else differs)."""


@dataclasses.dataclass(frozen=True)
class TrainingOptions:
    """A policy's training."""

    env_steps: int | None = None
    """Control steps of each training; the robot's preset where not given."""
    algorithm: str | None = None
    """sac, ppo, or ess_infogail, which imitates --demonstrations (ess_infogail_paper:
    as published, defects included; sac_paper: the paper's networks, rates and steps,
    hours of two cores); the robot's own where not given."""
    demonstrations: Path | None = None
    """Log of motion to imitate, made by train.demonstrate or recorded: a run is an
    episode, and SKILL:NAME as its name labels it."""
    labelled: float | None = None
    """Share of the labelled steps whose label is used, 0 to 1; all where not given."""
    skills: int | None = None
    """Skills that the policy has; not given: as many as there are labels, or one."""
    skill: str | None = None
    """The label of the skill that the finished policy plays, or its number from 0; the
    first where not given."""


@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """The search, and the least-squares finish after it."""

    preset: str = "default"
    """Search settings: default, or paper (the reference's recipe, defects included)."""
    strategy: str | None = None
    """Evolution strategy: mu_lambda, CMA_ES, Sep_CMA_ES, SNES, ..."""
    generations: int | None = None
    """Generations of the search (preset: 50)."""
    population: int | None = None
    """Individuals in a generation (preset: 300)."""
    set: tuple[str, ...] = ()
    """Further search settings, NAME=VALUE: loss=gan, regularizer=gradient_penalty,
    innovation_inputs=false, policy_updates_per_generation=20, ..."""
    start: tuple[float, float] | None = None
    """Where the search starts, as factors on the nominal values, such as 0.5 2; not
    given: where UDR trained, for logs the initial ranges of --parameters."""
    refine: bool = True
    """Finish with least squares on the paired data. The preset paper has no such finish
    unless --set finish=true asks for it."""
    restarts: int | None = None
    """More starts of the least-squares finish, drawn from the search's spread; the best
    fit counts. Not given: 2 for noisy data, none for clean ones, larger robots and
    logs."""


@dataclasses.dataclass(frozen=True)
class ChainOptions:
    """Demonstrations, final training and evaluation."""

    trajectories: int = 200
    """Demonstration trajectories."""
    noise: tuple[float, ...] = ()
    """Sensor noise, standard deviations: of each degree of freedom's position [m, rad],
    then of each one's velocity [m/s, rad/s]; with --policy of each channel that is
    compared. Added to pseudo-real demonstrations; for logs estimated where not
    given."""
    warm_start: bool = True
    """Final training goes on from the networks of the UDR policy in place of new ones
    (the Oracle's, too): it gets further where a training of its length has not settled.
    The preset paper trains anew unless --set goes_on=true."""
    eval_episodes: int = 100
    """Episodes of the final evaluation."""


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """The folder of a run, and the processes that share it."""

    resume: bool = False
    """Go on with the run in the folder."""
    overwrite: bool = False
    """Delete the run in the folder first."""
    distributed: bool = False
    """One of several processes (srun, mpirun, Kubernetes) whose devices share the
    work."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseOptions:
    """How the machine stood while logs were recorded, and what of it was measured."""

    held_base: bool = False
    """The base was held (in a stand): remove the model's free joint. The base stays at
    its first logged pose, or else at that of the first key frame or of the model."""
    unmeasured: tuple[str, ...] = ()
    """Joints that no sensor measured, by name or pattern (*_play); all: whatever a log
    lacks. Their positions and velocities are then unknown at the start of every
    prediction. Joints that the model itself places (coupled to a measured one, held by
    an equality, play beside one) need not be named."""
