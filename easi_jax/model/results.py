"""What commands found, as plain values: files and reports are made from these."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from easi_jax.model.found_effects import EffectEntry, FoundEffects
from easi_jax.model.found_laws import law_of, public_name

Flag = Literal["determined", "not determined", "at bound"]
Outcome = Literal["converged", "at bound", "not determined", "diverged"]
LEAK = 0.05  # part of a parameter in what is unseen, above which it is not known
# Steps (s,) and returns (s, seeds) of a training.
Curve = tuple[list[int], list[list[float]]]
Values = Mapping[str, tuple[float, float, str]]  # value, standard deviation, unit


UNMEASURED = "not measured"  # the reason why a joint without readings is no channel


@dataclass(frozen=True)
class Site:
    """Where an effect acts.

    Attributes:
        at: a place of the model, or a pattern; "" for the whole model.
        gap_after: held-out gap with the effect there and those before it.
        like: places that the pattern stands for, which have the effect alike.
    """

    at: str
    gap_after: float
    like: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Places of the model."""
        return self.like or (self.at,)


@dataclass(frozen=True)
class NamedEffect:
    """One effect that a model lacks, or that is in a sensor's readings.

    Attributes:
        effect: name.
        kind: what its places are: joint, actuator, body, sensor, geom or model.
        sites: where it acts; several where actuators have it alike that are not like
            each other.
        values: of its parameters.
        confidence: probability of this name against its rivals.
        indistinguishable: rivals that predict the held-out data as well.
        gap_before: held-out gap before it.
        columns: values of fields of `easi_jax.model.effects.Effects`, by name.
        std: their standard deviations, where known.
        shared: whether it was found as one of all actuators.
        cost: of taking it out, in cross-validated log density: nats for each
            independent number that was read; None where no prediction uses it.
        outcome: how the fit of its values ended.
        sure: standard errors between blocks of time by which it helps; None as
            ``cost``.
        odds: of its rivals together against it, twins aside; None as ``cost``.
    """

    effect: str
    kind: str
    sites: tuple[Site, ...]
    values: Values
    confidence: float
    indistinguishable: tuple[str, ...]
    gap_before: float
    columns: Mapping[str, float]
    std: Mapping[str, float]
    shared: bool = False
    cost: float | None = None
    outcome: Outcome = "converged"
    sure: float | None = None
    odds: float | None = None

    @property
    def label(self) -> str:
        """``effect@at``, ``effect@all``, or ``effect@PATTERN``."""
        return f"{self.name}@{'all' if self.shared else self.sites[0].at}"

    @property
    def at(self) -> tuple[str, ...]:
        """All places of the model where it acts; ``("",)`` for the whole model."""
        return tuple(name for site in self.sites for name in site.names)

    @property
    def name(self) -> str:
        """Of the effect, as files have it."""
        return public_name(self.effect)

    @property
    def law(self) -> str:
        """Its formula, where it is a law that was found; else empty."""
        law = law_of(self.effect)
        if law is None:
            return ""
        return law.shown([self.values[n][0] for n in law.numbers], self.force_unit)

    @property
    def force_unit(self) -> str:
        """N m or N: of a law's numbers, before what they are per."""
        return "N m" if "N m" in next(iter(self.values.values()))[2] else "N"

    @property
    def gap_after(self) -> float:
        """Held-out gap with it and those before it."""
        return self.sites[-1].gap_after

    @property
    def rises(self) -> bool:
        """Whether the held-out gap rises with it."""
        return self.gap_after > self.gap_before


@dataclass(frozen=True)
class Refitted:
    """A model's own parameter that a refit moved, SI units; ``outcome`` says how its
    fit ended."""

    address: str
    nominal: float
    value: float
    std: float
    outcome: Outcome = "converged"


@dataclass(frozen=True)
class GapFigures:
    """Held-out gap of one model.

    Attributes:
        gap: in units of the motion.
        interval: its 95 % interval.
        si: RMS error of each channel, in its unit.
        si_intervals: simultaneous 95 % intervals of those.
        not_finite: windows whose prediction is not.
    """

    gap: float
    interval: tuple[float, float]
    si: tuple[float, ...]
    si_intervals: tuple[tuple[float, float], ...] = ()
    not_finite: int = 0


@dataclass(frozen=True)
class ErrorPlace:
    """A joint's share of the squared gap, and when its error is largest."""

    at: str
    share: float
    when: str


@dataclass(frozen=True)
class ErrorMap:
    """RMS errors of joints under conditions, as shares of their motion.

    Attributes:
        joints, conditions: names.
        before, after: ``(joints, conditions)``; NaN where it did not occur.
        floor: of each joint, ``(joints,)``.
    """

    joints: tuple[str, ...]
    conditions: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    floor: np.ndarray


@dataclass(frozen=True)
class Traces:
    """Measured and predicted motion in some windows.

    Attributes:
        time: ``(H + 1,)`` [s].
        measured, before, after: ``(windows, H + 1, channels)``.
        names, units: of the channels.
    """

    time: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]


@dataclass(frozen=True)
class LawCurve:
    """The force of a law that was found, over motion that no fit has seen.

    Attributes:
        law: its formula.
        against: what it is shown against, with its unit.
        x, force: ``(T,)``.
        unit: of the force.
    """

    law: str
    against: str
    x: np.ndarray
    force: np.ndarray
    unit: str


@dataclass(frozen=True)
class Retrained:
    """Returns of policies in the repaired model, by seed.

    Attributes:
        env_steps: of each training; None where the preset's.
        without, with_effects: trained without what was found, and with it.
    """

    robot: str
    env_steps: int | None
    without: Mapping[str, float]
    with_effects: Mapping[str, float]


@dataclass(frozen=True)
class GapResult:
    """What the gap workflow found; see the log format's ``gap.json``.

    Attributes:
        model: name.
        verdict: ``explained``, ``no_gap`` or ``unexplained``.
        effects: that the model lacks, in their order.
        readings: effects in the readings of sensors.
        before, refit, after: as given, own parameters refitted, with the effects.
        floor: gap of a perfect model; ``floor_si`` of each channel, in its unit.
        channels, units: what is compared.
        ignored: reason for each channel that is left out.
        held_out: runs; ``held_name`` says it in words.
        horizon: of the predictions [s].
        disagreeing: runs that the model predicts far worse than the others, with how
            many times.
        seconds: that it took; ``law_seconds`` of these went into laws.
        start: time on either side of a start that it is fitted to [s].
        open: channels whose error is surely beyond 1.25 times their floor; the empty
            name stands for all together.
        bounded: channels whose floor is an upper bound, since their noise cannot be
            told from motion.
        undecided: channels of which these data do not tell.
        notes: what the user should know.
        where: places of the remaining error, largest first; None where not known.
        record_next: what to record to tell names apart, a sentence for each pair.
        not_in_model_xml: what MJCF has no word for; None where it was not written.
        retrained: None where no policy was.
        known_effects: where laws were found, the held-out gap that the effects of the
            catalog leave without them; else None.
    """

    model: str
    verdict: str
    effects: tuple[NamedEffect, ...]
    readings: tuple[NamedEffect, ...]
    refitted: tuple[Refitted, ...]
    before: GapFigures
    refit: GapFigures
    after: GapFigures
    floor: float
    floor_si: tuple[float, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    ignored: Mapping[str, str]
    held_out: tuple[str, ...]
    held_name: str
    horizon: float
    disagreeing: Mapping[str, float]
    seconds: float
    start: float = 0.0
    law_seconds: float = 0.0
    open: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    bounded: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    where: tuple[ErrorPlace, ...] | None = None
    record_next: tuple[str, ...] = ()
    not_in_model_xml: tuple[str, ...] | None = None
    retrained: Retrained | None = None
    known_effects: float | None = None

    def times_floor(self, gap: float) -> float:
        """A gap in units of that of a perfect model."""
        return gap / self.floor if self.floor > 0 else math.inf

    def share(self, before: float, after: float) -> float | None:
        """Part of the gap between refit and floor that a fall from ``before`` to
        ``after`` is, squared; None where there is no gap."""
        whole = self.refit.gap**2 - self.floor**2
        if self.verdict == "no_gap" or whole <= 0:
            return None
        return (before**2 - after**2) / whole

    @property
    def found(self) -> FoundEffects:
        """Effects and refitted values, as models are given them."""
        entries = (
            EffectEntry(e.effect, at, e.kind, e.columns, e.std)
            for e in (*self.effects, *self.readings)
            for at in e.at
        )
        return FoundEffects(tuple(entries), {r.address: r.value for r in self.refitted})

    def noted(self, notes: Sequence[str]) -> "GapResult":
        """With more notes."""
        return replace(self, notes=(*self.notes, *notes))


@dataclass(frozen=True)
class Undetermined:
    """A direction in which data see nothing.

    Attributes:
        coefficients: parameter to its power (or step, where it is linear).
        meaning: the same as a sentence.
    """

    coefficients: dict[str, float]
    meaning: str


@dataclass(frozen=True)
class Relative:
    """Parameters once some are known that data alone do not determine.

    Masses and lengths along undetermined directions are taken as the model has them,
    as their owner has weighed or measured them. The others are fitted again with them.

    Attributes:
        taken: these parameters and their values in the model, SI.
        mean, std: of all parameters then, ``n`` each, SI.
        determined: of each parameter, whether the data determine it then.
        gain: ``(n, k)``: how far each parameter moves with each of ``taken``, both as
            log ratios, or in initial ranges where a parameter is linear.
    """

    taken: dict[str, float]
    mean: list[float]
    std: list[float]
    determined: list[bool]
    gain: list[list[float]]

    def depends(self, i: int) -> list[str]:
        """Those of ``taken`` that the value of parameter ``i`` rests on."""
        pairs = zip(self.taken, self.gain[i], strict=True)
        return [name for name, gain in pairs if abs(gain) > LEAK]


@dataclass(frozen=True)
class SeedResult:
    """What one seed found, as ``distribution.json`` holds it.

    Attributes:
        mean, std: ``n`` each, SI.
        interval_68: ``(n, 2)``, SI.
        unit_mean, unit_covariance: in unit coordinates.
        flags: what may be believed of each parameter by itself.
        cramer_rao_std: least standard deviation of log ratios that the data allow.
        determined_directions: how many there are.
        undetermined: the other directions.
        relative: None where no mass or length settles a direction.
        outcome: how its fit ended; ``reason`` names what it is about. One that diverged
            has no result, and is no `SeedResult`.
        no_region: why no region is stated about ``mean``; empty where one is.
    """

    mean: list[float]
    std: list[float]
    interval_68: list[list[float]]
    unit_mean: list[float]
    unit_covariance: list[list[float]]
    flags: list[Flag]
    cramer_rao_std: list[float]
    determined_directions: int
    undetermined: list[Undetermined]
    relative: Relative | None = None
    outcome: Outcome = "converged"
    reason: str = ""
    no_region: str = ""


@dataclass(frozen=True)
class Shares:
    """Prediction errors as shares of the motion, on motion that no search has seen.

    Attributes:
        channels: positions and velocities, ``2 nv``.
        one_step, open_loop: model to errors ``(S, 2 nv)``, after one control step and
            after 0.2 s.
    """

    channels: tuple[str, ...]
    one_step: Mapping[str, np.ndarray]
    open_loop: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Transfer:
    """How policies do in a pseudo-real target.

    Attributes:
        robot: its name.
        returns: method to ``(S,)``; the first is what recorded the demonstrations.
        episodes: for each seed.
        curves: method to its training, evaluated in the target.
        held_out: prediction errors of the models.
        non_finite: simulations of the search that were lost.
    """

    robot: str
    returns: Mapping[str, np.ndarray]
    episodes: int
    curves: Mapping[str, Curve]
    held_out: Shares
    non_finite: int


@dataclass(frozen=True)
class HeldOutErrors:
    """Open-loop errors on held-out logs, a number a channel, SI.

    Attributes:
        what: which data were held out.
        horizon: of the prediction [s].
        before: of the model as given.
        after: of each seed's model.
        floor: of each seed's model, were it perfect.
        fit: of each seed, the error on its own data, which chooses the seed shown;
            empty of a single one.
        measure: how they are measured, in words.
        windows: that errors are measured on; 0 where there are none.
        not_finite: windows whose prediction is not finite, by the model as given and
            then by each seed's; each counts as an error of the largest motion.
    """

    what: str
    horizon: float
    channels: list[str]
    units: list[str]
    before: list[float]
    after: list[list[float]]
    floor: list[list[float]]
    fit: list[float]
    measure: str = (
        "RMS over all steps of all windows, open loop from the fitted start, windows "
        "every half horizon"
    )
    windows: int = 0
    not_finite: list[int] = field(default_factory=list)

    @property
    def best(self) -> int:
        """Place of the seed that fits its own data best."""
        return int(np.argmin(self.fit)) if self.fit else 0

    def notes(self, seeds: Sequence[int]) -> list[str]:
        """One on each model that some held-out windows explode with; results are those
        of ``seeds``."""
        models = ("the model as given", *(f"the result of seed {s}" for s in seeds))
        return [
            f"{lost} of {self.windows} held-out windows are not finite with {model}: "
            "each counts as an error of the largest motion"
            for model, lost in zip(models, self.not_finite, strict=False)
            if lost
        ]


# -- what to record ----------------------------------------------------------------


@dataclass(frozen=True)
class Signal:
    """A test.

    Attributes:
        what: in words.
        kind: of signal; ``band`` [Hz]; ``level``, share of the largest safe amplitude.
        amplitude, hold: of each actuator, in units of its command.
        start: position of each joint.
        seed: of its random parts.
        duration: [s].
        rate: rows per second.
    """

    what: str
    kind: str
    band: tuple[float, float]
    level: float
    amplitude: Mapping[str, float]
    hold: Mapping[str, float]
    start: Mapping[str, float]
    seed: int
    duration: float
    rate: float


@dataclass(frozen=True)
class Controller:
    """That a feed-forward test was simulated with; gains by actuator."""

    assumed: str
    kp: Mapping[str, float]
    kd: Mapping[str, float]


@dataclass(frozen=True)
class JointUse:
    """What a joint may do, and does: in the model and in the wrong ones, or
    (``model_reaches``) in the model alone. ``range`` is the model's; None without."""

    allowed: tuple[float, float]
    reached: tuple[float, float]
    model_reaches: tuple[float, float]
    range: tuple[float, float] | None
    speed_allowed: float
    speed_reached: float


@dataclass(frozen=True)
class ActuatorUse:
    """What an actuator may do, and does, in all models."""

    ctrl_allowed: tuple[float, float]
    ctrl_reached: tuple[float, float]
    force_allowed: float
    force_reached: float


@dataclass(frozen=True)
class NumberSeen:
    """A number of an effect at its size, and how well the test would tell it."""

    name: str
    unit: str
    size: float
    std: float
    std_per_size: float


@dataclass(frozen=True)
class EffectSeen:
    """What a test says of an effect: distances from nothing (``visible``) and from its
    nearest rival (``apart``), in units of noise."""

    visible: float
    nearest: str | None
    apart: float
    numbers: tuple[NumberSeen, ...]


@dataclass(frozen=True)
class PairSeen:
    """How far an effect is from its rival, in units of noise and of `visible`."""

    effect: str
    rival: str
    apart: float
    of_visible: float


@dataclass(frozen=True)
class PairWanted:
    """A pair that was to be told apart: by this test, and by the best of all."""

    effect: str
    rival: str
    apart: float
    best_of_all: float
    no_test_can: bool


@dataclass(frozen=True)
class Alias:
    """An effect that no test tells from another: its twin, or a case of it."""

    effect: str
    rival: str
    twins: bool


@dataclass(frozen=True)
class Tried:
    """A test that was tried."""

    what: str
    amplitude: Mapping[str, float]
    score: float


@dataclass(frozen=True)
class ExciteResult:
    """What ``train.excite`` chose, and what it promises.

    Attributes:
        model: name.
        signal: the test that was chosen, of ``score``.
        controller: of feed-forward tests; None where commands are all that is sent.
        margin: share of a joint's range that is left free at both ends.
        joints, actuators: limits and what is reached.
        noise: of each joint's position.
        horizon: of the predictions that train.gap will make [s].
        effects: what the test says of each.
        worst_pairs: that it tells apart worst.
        told_apart: pairs that were asked for.
        no_trace: effects that show in no test.
        twins: names that no test tells apart.
        tried: tests, the best first.
        windows, changes: windows of each test and changes of the model that were
            simulated.
        notes: what the user should know.
    """

    model: str
    signal: Signal
    controller: Controller | None
    margin: float
    joints: Mapping[str, JointUse]
    actuators: Mapping[str, ActuatorUse]
    score: float
    noise: Mapping[str, float]
    horizon: float
    effects: Mapping[str, EffectSeen]
    worst_pairs: tuple[PairSeen, ...]
    told_apart: tuple[PairWanted, ...]
    no_trace: tuple[str, ...]
    twins: tuple[Alias, ...]
    tried: tuple[Tried, ...]
    windows: int
    changes: int
    notes: tuple[str, ...]
