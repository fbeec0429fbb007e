"""All thresholds of the gap workflow that decide what people are told, in one place.

Each says its quantity and unit, its reason and, where it is a test, how often chance
alone passes it. Tests between blocks of time have ten blocks (`BLOCKS`): their chance
is that of Student's t with nine degrees of freedom. Many names are tried, so that the
chance of one false name among them is larger; `benchmarks.gap` counts it on machines
without any effect. Constants that only save time, or set how numbers are computed,
stand where they are used.
"""

from dataclasses import dataclass

BLOCKS = 10
"""Blocks of time of the fitting data, left out in turn (cross-validation)."""


@dataclass(frozen=True)
class Decisions:
    """The thresholds."""

    # -- what is open ----------------------------------------------------------

    open_from: float = 1.25
    """Times the floor: a channel whose error is surely beyond that is open, and so is
    the whole. Of the contract; no machine quite follows any physics."""

    interval: float = 0.95
    """Probability of the intervals of all channels together (bootstrap over blocks,
    Bonferroni): chance opens a perfect model in 5 % at most."""

    closed: float = 1.05
    """Times the floor: while the error of some channel is not surely beyond that, no
    further effect is looked for. The floor is known to some 3 %; the interval above
    applies."""

    visible: float = 5.0
    """Times the noise: the least change over a horizon that makes a channel one. Of the
    contract; chance reaches it in 6e-7 of rows."""

    # -- whether an effect joins -----------------------------------------------

    sure: float = 1.7
    """Standard errors between blocks by which an effect helps: together over the loss
    in units of the noise and of the gap twice that, each of them for an effect that
    machines rarely have. Chance: 6.2 % for one name where the two measures go
    together."""

    likely: float = 1.0
    """Standard errors, likewise, by which it helps in either measure. Chance: 17 %,
    beside `sure`."""

    helps: float = 0.05
    """Share of the squared gap that each number of an effect earns, so that no effect
    is named that nobody would miss; a third of it in the other measure, and twice as
    much in both for rare effects. No test: what fitting one number to noise gains
    falls with the data, this does not."""

    helps_when_closed: float = 3.0
    """Times as much, where the gap is below `open_from` floors already."""

    large_gain: float = 0.3
    """Share of the loss from which on a gain is also judged by ratios of losses: where
    a few blocks hold most of the error, differences scatter as much as they are
    large."""

    few_windows: float = 0.25
    """Share of the windows, at most, in which an effect acts that is judged in these
    alone, one by one (a limit that is seldom reached)."""

    least_windows: int = 3
    """Windows that it takes for that. Chance is that of `sure` again, with standard
    errors of as many windows, taken 1.4 times as large since windows overlap."""

    rare: float = 0.1
    """Relative loss: a prior for the kind of effect. By so much a rare effect has to be
    better than an ordinary one, and an ordinary one than friction, damping or rotor
    inertia, which nearly all drives have. Beside a rival each of these steps is half a
    standard error between blocks, as each further number is: odds of 1 to 2.2. No
    test."""

    tried: int = 20
    """Names that promise most at a stage: only these are tried beside the other sets of
    effects, and only what was among them at some stage is a rival. No test: a twin
    promises as much as its twin."""

    most: int = 5
    """Effects. The largest of the contract's machines has five."""

    probable: float = 0.7
    """Confidence of an effect, with what is within `open_from` floors left out of what
    it closes, below which it is not named where nothing is open without it: what nobody
    misses has to be more than twice as likely right as wrong."""

    # -- which of several names ------------------------------------------------

    as_good: float = 1.5
    """Standard errors between blocks within which the simpler of two candidates wins.
    Chance: the better one is given up in 8.4 % where it is as much better as that."""

    nearly: float = 0.7
    """Share of what the best explains, from which on what it contains as a special case
    comes first; the rest is asked for later. No test."""

    replaced_below: float = 0.3
    """Probability of an effect beside a rival, below which the rival takes its
    place."""

    says_nothing: float = 0.02
    """Difference of logarithms of losses that tells no two names apart: the least
    standard error in their odds, which ten equal blocks would make zero."""

    twins: float = 0.1
    """Of the noise: names whose predictions differ by less, RMS, are twins: 100
    independent rows would tell them apart by one standard error."""

    even: float = 0.28
    """Nats for each number, lost without an effect, at which its name is as often wrong
    as right: half the logarithm of what is then open, by what is open with it. Fitted
    by maximum likelihood to the names of generated machines, most of which also lack
    what no effect of the table is (`benchmarks.gap_confidence`, which tests it on
    others)."""

    steep: float = 0.89
    """How fast that changes with the logarithm of the loss; likewise. The standard
    errors of an effect's help say no more beside its cost: with them mechanisms that
    were left out were predicted no better."""

    does_nothing: float = 1e-3
    """Of the largest error: an effect that changes less was fitted to nothing. No test:
    beyond rounding, below any noise."""

    felt: float = 1e-3
    """Of the most that a number of an effect changes: numbers that change less are not
    counted. No test."""

    touches: float = 0.02
    """Share of the rows in which a pair of geoms touches, for it to be a candidate. No
    test: less has too few windows to be judged in."""

    # -- laws that nobody listed -----------------------------------------------

    law_terms: int = 4
    """Terms, at most."""

    law_sure: float = 2.5
    """Standard errors between blocks by which a term predicts blocks that it was not
    fitted to. Chance: 1.7 % for one term; the best of some hundred passes more often,
    which is why what is proposed is confirmed in full simulation as effects are."""

    law_gain: float = 0.1
    """Share of the loss that is left, which a term takes. No test, as `helps`."""

    law_of_first: float = 0.02
    """Share of the loss at first: less may be what linearizing leaves."""

    law_as_good: float = 0.95
    """Of the best gain, from which on what takes less to say wins."""

    # -- readings ---------------------------------------------------------------

    late: float = 0.003
    """Seconds: velocities and sensors that lag less are the velocity fit's own doing;
    half a row, too."""

    late_explains: float = 0.5
    """Share of the squared difference that a shift explains. No test: noise alone has
    no shift that explains any."""

    own_steps: float = 1.5
    """Physics steps: readings that are taken before a step are that late by
    themselves."""

    bias_sure: float = 3.0
    """Standard errors between ten pieces of the data. Chance: 1.5 %."""

    bias_small: float = 0.01
    """Of what moves: a constant below it is no news."""

    geometry: float = 0.5
    """Probability that the sensor, and not a length of the model, is off, where either
    would do: nothing in the data tells."""

    # -- notes ------------------------------------------------------------------

    steps_told: float = 0.8
    """Of the gap: where it falls below that without the error of the physics step, a
    note says so."""

    no_difference: float = 0.005
    """Of the gap: smaller differences are rounding."""

    odd_run: float = 3.0
    """Times the error of other runs, from which on a run is named as unlike them.
    Chance: none of thousands of runs of one machine, whose errors scatter by tens of
    percents."""

    followed: float = 1.5
    """Times the floor, below which the model predicts the other runs."""

    when_ratio: float = 1.3
    """Times as much squared error as elsewhere, for a condition to be told with the
    joint where the gap is."""

    when_windows: int = 8
    """Windows in and out of such a condition, at least."""

    near_end: float = 0.05
    """Of a joint's range: what counts as near its end."""

    one_way: float = 0.02
    """Share of the travel that the way back has at least; else a log is said to go one
    way only."""

    faster: float = 1.5
    """Times what the fitting data reach: held-out data beyond it are told."""

    fed_back: float = 0.5
    """Share of what is new in commands that the state tells: more is feedback, and
    told."""

    fed_back_rows: int = 50
    """Rows for each position that can tell that."""


DECIDE = Decisions()
"""The thresholds in use."""
