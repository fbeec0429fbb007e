"""What becomes of a command on its way to an actuator, at the truth's fine step.

Each stage has `reset(rng)` and `pass_on(command, time, fresh)`: the command of its
actuator, seconds since the run's first row, whether a control step starts here.
"""

import math
from typing import Protocol

import numpy as np


class Stage(Protocol):
    """One stage of one actuator's path."""

    at: int

    def reset(self, rng: np.random.Generator) -> None: ...

    def pass_on(self, command: float, time: float, fresh: bool) -> float: ...


class Dropped:
    """Commands lost at random: the one before is held."""

    def __init__(self, at: int, probability: float) -> None:
        self.at, self.probability = at, probability

    def reset(self, rng: np.random.Generator) -> None:
        self.rng = np.random.default_rng(rng.integers(2**63))
        self.held: float | None = None

    def pass_on(self, command: float, time: float, fresh: bool) -> float:
        del time
        if self.held is None or (fresh and self.rng.random() >= self.probability):
            self.held = command
        return self.held


class Delayed:
    """A fixed delay of a whole number of fine steps."""

    def __init__(self, at: int, delay: float, fine: float) -> None:
        self.at, self.length = at, round(delay / fine)

    def reset(self, rng: np.random.Generator) -> None:
        del rng
        self.buffer: list[float] = []
        self.head = 0

    def pass_on(self, command: float, time: float, fresh: bool) -> float:
        del time, fresh
        if self.length == 0:
            return command
        if not self.buffer:
            self.buffer = [command] * self.length
        late, self.buffer[self.head] = self.buffer[self.head], command
        self.head = (self.head + 1) % self.length
        return late


class Deadband:
    """Commands below `width` in size give nothing; those beyond lose it or not."""

    def __init__(self, at: int, width: float, subtractive: bool) -> None:
        self.at, self.width, self.subtractive = at, width, subtractive

    def reset(self, rng: np.random.Generator) -> None:
        del rng

    def pass_on(self, command: float, time: float, fresh: bool) -> float:
        del time, fresh
        if abs(command) < self.width:
            return 0.0
        lost = math.copysign(self.width, command) if self.subtractive else 0.0
        return command - lost


class Gain:
    """A constant factor, or one that drifts by `drift` over `duration`."""

    def __init__(
        self, at: int, gain: float, drift: float = 0.0, duration: float = 1.0
    ) -> None:
        self.at, self.gain, self.drift, self.duration = at, gain, drift, duration

    def reset(self, rng: np.random.Generator) -> None:
        del rng

    def pass_on(self, command: float, time: float, fresh: bool) -> float:
        del fresh
        return command * (self.gain + self.drift * max(0.0, time) / self.duration)


class Bent:
    """Large commands count for more, or less: a share of their square is added."""

    def __init__(self, at: int, bend: float) -> None:
        self.at, self.bend = at, bend

    def reset(self, rng: np.random.Generator) -> None:
        del rng

    def pass_on(self, command: float, time: float, fresh: bool) -> float:
        del time, fresh
        return command * (1.0 + self.bend * abs(command))


class Lag:
    """First-order response, exact for commands held during a fine step."""

    def __init__(self, at: int, time_constant: float, fine: float) -> None:
        self.at, self.share = at, -math.expm1(-fine / max(time_constant, 1e-9))

    def reset(self, rng: np.random.Generator) -> None:
        del rng
        self.state: float | None = None

    def pass_on(self, command: float, time: float, fresh: bool) -> float:
        del time, fresh
        if self.state is None:
            self.state = command
        self.state += self.share * (command - self.state)
        return self.state
