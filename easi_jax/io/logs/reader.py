"""Reads measured logs into runs, and writes runs as logs.

The format is one table with a row per control step; see ``docs/your_own_robot.md``.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from easi_jax.data.recording import Log, Run
from easi_jax.data.resampling import (
    EVEN,
    Rows,
    is_even,
    mean_held,
    recordings,
    resampled,
)
from easi_jax.data.unmeasured import (
    apart_from,
    hidden_in_any,
    joint_dofs,
    measured_alike,
    with_guess,
)
from easi_jax.data.windows import fitted_velocity
from easi_jax.errors import UserError
from easi_jax.io.logs import checks as log_checks
from easi_jax.io.logs.columns import (
    LogColumns,
    check_columns,
    hidden_joints,
    log_columns,
)
from easi_jax.io.logs.mapping import LogMapping, read_mapping
from easi_jax.io.logs.tables import Table, read_table, write_table
from easi_jax.io.models.completed import base_joint, held_body
from easi_jax.model.joint_space import FREE_WIDTH, Configuration, given_name, numbered

PathLike = str | os.PathLike[str]

HOLE_STEPS = 3.0
# Share of the rows with a velocity, from which on a joint's count as measured: what is
# estimated in the others has less noise, so that the noise told is at most 3 % low.
_GIVEN = 0.95
_HELD_WITHIN = 0.05  # m and rad that a stand may give, and readings be off


def read_logs(
    paths: PathLike | Sequence[PathLike],
    mj_model: mujoco.MjModel,
    mapping: PathLike | None = None,
    unmeasured: Sequence[str] = (),
    beside: Sequence[PathLike] = (),
) -> Log:
    """Reads logs of the machine ``mj_model`` describes.

    Rows with a non-finite time, position or command are dropped and split the run,
    as does a hole longer than three control steps. The control step is the median
    of a recording's time differences; rows that are irregular in time are brought
    to it, commands held and positions interpolated. Quaternions are normalized and
    made continuous in sign; positions of hinges in whose range a full turn fits are
    unrolled where they jump by a turn. A few rows that repeat the time stamp of the
    row before are dropped.

    A joint may lack its columns where ``unmeasured`` or the model itself allows it
    (`easi_jax.data.unmeasured.placed_by_model`). What one of the files lacks is hidden
    in all runs; its positions are then a guess that obeys the model.

    Args:
        paths: one or more files: ``.csv``, ``.npz`` or ``.parquet``.
        mj_model: names and ranges of joints, actuators and sensors.
        mapping: mapping file for all of ``paths``, for logs in a foreign format.
        unmeasured: joints without a sensor, by name or pattern; ``all``: whatever a
            log lacks. Columns of joints that are named are not read.
        beside: other files in use: runs of equal file names go by their paths.

    Returns:
        At least one run, each of at least two rows; notes on all that a user
        should know.

    Raises:
        UserError: a file that cannot be used, in one line that says why.
    """
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    files = [Path(path) for path in paths]
    if not files:
        raise UserError("no log given")
    places = [os.path.realpath(path) for path in files]
    for path, place in zip(files, places, strict=True):
        if places.count(place) > 1:
            raise UserError(f"{path} is given more than once")
    columns = log_columns(mj_model)
    names = LogMapping() if mapping is None else read_mapping(mapping)
    stems = [Path(path).stem for path in (*files, *beside)]
    runs: list[Run] = []
    notes: list[str] = []
    for path in files:
        alone = stems.count(path.stem) == 1
        name = path.stem if alone else path.as_posix()
        reader = _Reader(mj_model, columns, names, path, name, unmeasured)
        runs += reader.read()
        notes += reader.notes
    runs, more = measured_alike(mj_model, runs)
    return Log(tuple(runs), (*notes, *more))


def write_log(
    path: PathLike,
    mj_model: mujoco.MjModel,
    runs: Run | Iterable[Run],
    *,
    velocities: bool = True,
    digits: int | None = None,
) -> None:
    """Writes runs as one log that :func:`read_logs` reads back.

    Args:
        path: ends in ``.csv``, ``.npz`` or ``.parquet``; appears whole or not at
            all.
        mj_model: the model whose joints and actuators name the columns.
        runs: one or more; several get a ``run`` column with their names.
        velocities: whether ``qvel`` columns are written.
        digits: significant digits of a CSV; None for all that round-trip.

    Raises:
        UserError: another extension, no run, or a place that cannot be written.
        ValueError: arrays that do not fit the model, or names given twice.
    """
    chosen = [runs] if isinstance(runs, Run) else list(runs)
    if not chosen:
        raise UserError(f"{path}: no run to write")
    if len({run.name for run in chosen}) < len(chosen):
        raise ValueError("two runs of one name cannot be written to one log")
    columns = log_columns(mj_model)
    out: dict[str, np.ndarray] = {
        "time": np.concatenate([run.time for run in chosen]),
    }
    if len(chosen) > 1:
        out["run"] = np.repeat([r.name for r in chosen], [len(r) for r in chosen])
    blocks = [(columns.qpos, [run.qpos for run in chosen])]
    if velocities:
        blocks.append((columns.qvel, [run.qvel for run in chosen]))
    blocks.append((columns.ctrl, [run.ctrl for run in chosen]))
    hidden = hidden_in_any(chosen)
    left_out = {
        name
        for j in range(mj_model.njnt)
        if hidden[mj_model.jnt_dofadr[j]]
        for name in (*columns.positions[j], *columns.joints[j])
    }
    for name in dict.fromkeys(name for run in chosen for name in run.sensors):
        names = columns.sensors[name]
        read = [r.sensors.get(name, _unread(len(r), len(names))) for r in chosen]
        blocks.append((names, read))
    for names, arrays in blocks:
        values = np.concatenate(arrays)
        out |= dict(zip(names, values.T, strict=True))
    out = {name: values for name, values in out.items() if name not in left_out}
    write_table(path, out, digits)


def _unread(rows: int, width: int) -> np.ndarray:
    return np.full((rows, width), np.nan)


def first_pose(
    paths: Sequence[PathLike],
    mj_model: mujoco.MjModel,
    mapping: PathLike | None = None,
) -> np.ndarray | None:
    """The base's first logged pose ``(7,)``, or None where no log has it.

    Raises:
        UserError: as `easi_jax.io.models.completed.base_joint` and `read_logs`.
    """
    name = mj_model.joint(base_joint(mj_model)).name
    names = LogMapping() if mapping is None else read_mapping(mapping)
    for path in paths:
        table = names.rename(read_table(Path(path)))
        pose = _poses(table, numbered(f"qpos.{name}", FREE_WIDTH), names)
        if pose is not None:
            return pose[0]
    return None


def _poses(
    table: Table, names: Sequence[str], mapping: LogMapping
) -> np.ndarray | None:
    """A free joint's finite poses ``(T, 7)``; None where the table has none."""
    if not names or any(name not in table.columns for name in names):
        return None
    pose = np.stack([mapping.apply(n, table.numbers(n)) for n in names], 1)
    length = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    good = np.isfinite(pose).all(1) & (length[:, 0] > 0)
    pose[:, 3:] /= np.where(length > 0, length, 1.0)
    return pose[good] if good.any() else None


class _Reader:
    """Reads one file; collects what is to be said about it."""

    def __init__(
        self,
        model: mujoco.MjModel,
        columns: LogColumns,
        mapping: LogMapping,
        path: Path,
        name: str,
        unmeasured: Sequence[str],
    ):
        self.model = model
        self.columns = columns
        self.mapping = mapping
        self.path = path
        self.name = name
        self.unmeasured = unmeasured
        self.hidden: dict[int, str] = {}  # joints, and why
        self.configuration = Configuration.of(model)
        self.notes: dict[str, None] = {}  # in order, each once
        self.uneven: list[tuple[float, str]] = []

    def note(self, text: str) -> None:
        self.notes[f"{self.path}: {text}"] = None

    def read(self) -> list[Run]:
        table = self.mapping.rename(read_table(self.path))
        self.columns = self._as_numbered(table)
        for text in table.notes:
            self.note(text)
        given = self.path, table.columns, self.columns, self.model
        self.hidden = hidden_joints(*given, self.unmeasured)
        ignored = check_columns(*given, self.hidden)
        table = self._without_hidden(table)
        index = [name for name in ignored if table.counts_rows(name)]
        for name in index:
            self.note(f'column "{name}" counts the rows (an index): ignored')
        others = [name for name in ignored if name not in index]
        if others:
            self.note(f"columns ignored: {', '.join(others)}")
        raw = self._arrays(table)
        self._check_held(table)
        if len(raw.time) < 2:
            rows = "a single row" if len(raw.time) else "no rows"
            raise UserError(f"{self.path} has {rows}; a log needs at least two")
        time, notes = log_checks.plausible_times(self.path, raw.time)
        raw = raw._replace(time=time)
        motion = raw.qpos, raw.qvel, raw.ctrl
        log_checks.check_sizes(self.path, self.columns, *motion, raw.sensors)
        good = np.isfinite(raw.time)
        good &= np.isfinite(raw.qpos).all(1) & np.isfinite(raw.ctrl).all(1)
        if not good.all():
            first = int(np.flatnonzero(~good)[0]) + 1
            self.note(
                f"{np.sum(~good)} of {len(good)} rows dropped for a non-finite time, "
                f"position or command (the first is row {first})"
            )
        qpos, more = log_checks.normalized(
            self.path, self.model, raw.qpos, raw.label, good
        )
        raw = raw._replace(qpos=qpos)
        for text in (
            *notes,
            *more,
            *log_checks.quaternion_orders(
                self.path,
                self.model,
                raw.take(good),
                self.mapping.quaternions,
                self.hidden,
            ),
            *log_checks.ranges(self.model, qpos[good], raw.ctrl[good], self.hidden),
        ):
            self.note(text)
        runs: list[Run] = []
        for label, rows in recordings(raw.label):
            name = f"{self.name}/{label}" if label else self.name
            runs += self._recording(name, raw, rows, good[rows])
        if not runs:
            raise UserError(
                f"{self.path}: no two successive rows are whole and within "
                f"{HOLE_STEPS:.0f} control steps of each other; "
                f"{self._why_no_runs(raw)}"
            )
        still = log_checks.still_base(self.path, self.model, runs)
        if still:
            self.note(still)
        if self.uneven:
            worst, name = max(self.uneven)
            self.note(
                f"time steps differ from the control step by up to {100 * worst:.0f} % "
                f"({name}); brought to it by interpolation in {len(self.uneven)} of "
                f"{len(runs)} runs"
            )
        estimated = [
            group[0].removesuffix(".0")
            for j, group in enumerate(self.columns.joints)
            if group[0] not in table.columns and j not in self.hidden
        ]
        if estimated:
            some = len(estimated) + len(self.hidden) < len(self.columns.joints)
            so = "; so no velocity counts as measured" if some else ""
            names = ", ".join(estimated)
            self.note(f"velocities estimated from positions: {names}{so}")
        return runs

    def _why_no_runs(self, raw: Rows) -> str:
        """Which columns are mostly empty, or else what time does; and what to do."""
        names = ("time", *self.columns.qpos, *self.columns.ctrl)
        cells = np.column_stack([raw.time, raw.qpos, raw.ctrl])
        finite = np.isfinite(cells)
        whole, share = np.asarray(finite.all(1)), finite.mean(0)
        if (whole[1:] & whole[:-1]).any():
            return (
                "its time steps differ too much, or each recording of its column "
                '"run" is a single row: log at a steady rate'
            )
        empty = [
            f'"{names[i]}" has a number in {share[i]:.0%} of the rows'
            for i in np.argsort(share, kind="stable")[:3]
            if share[i] < 1.0
        ]
        return (
            f"{', '.join(empty)}: give a command in each row, as it was held; leave "
            "joints that nobody read out (--unmeasured)"
        )

    def _as_numbered(self, table: Table) -> LogColumns:
        """The model's columns, sensors of one number with ``.0`` where ``table`` has
        them so."""
        sensors, known = dict(self.columns.sensors), set(self.columns.known)
        for name, columns in sensors.items():
            numbered = f"{columns[0]}.0"
            other = numbered in table.columns and numbered not in known
            if len(columns) == 1 and other and columns[0] not in table.columns:
                sensors[name] = (numbered,)
        return replace(self.columns, sensors=sensors)

    def _without_hidden(self, table: Table) -> Table:
        """``table`` without columns of hidden joints, of which is told."""
        if not self.hidden:
            return table
        m, columns = self.model, self.columns
        said = ", ".join(f"{given_name(m, j)} ({w})" for j, w in self.hidden.items())
        self.note(
            f"joints without a reading, whose start is unknown in every prediction: "
            f"{said}"
        )
        apart = apart_from(m, joint_dofs(m, self.hidden))
        if apart:
            self.note(
                f"only contacts and couplings tie {_names(m, apart)} to what is "
                "measured: without them nothing is determined there"
            )
        groups = [(*columns.positions[j], *columns.joints[j]) for j in self.hidden]
        names = [n for group in groups for n in group if n in table.columns]
        if names:
            self.note(
                f"columns of joints without a reading not read: {', '.join(names)}"
            )
        kept = {n: c for n, c in table.columns.items() if n not in names}
        return replace(table, columns=kept)

    def _arrays(self, table: Table) -> Rows:
        rows = table.rows("time")

        def column(name: str) -> np.ndarray:
            if name not in table.columns:
                return np.full(rows, np.nan)
            values = self.mapping.apply(name, table.numbers(name))
            if len(values) != rows:
                raise UserError(
                    f'{self.path}: column "{name}" has {len(values)} rows '
                    f"where time has {rows}"
                )
            return values

        def block(names: Sequence[str]) -> np.ndarray:
            columns = [column(name) for name in names]
            return np.stack(columns, 1) if columns else np.zeros((rows, 0))

        label = np.full(rows, "")
        if "run" in table.columns:
            label = table.labels("run")
            if len(label) != rows:
                raise UserError(
                    f'{self.path}: column "run" has {len(label)} rows '
                    f"where time has {rows}"
                )
        sensors: dict[str, np.ndarray] = {}
        for name, names in self.columns.sensors.items():
            given = [n for n in names if n in table.columns]
            if len(given) == len(names):
                sensors[name] = block(names)
            elif given:
                self.note(f"sensor {name} ignored: it has {len(names)} columns")
        sensors, codes = log_checks.without_codes(sensors)
        for text in codes:
            self.note(text)
        time, qpos = column("time"), block(self.columns.qpos)
        for j in self.hidden:  # a guess follows, row by row
            at = int(self.model.jnt_qposadr[j])
            at = slice(at, at + len(self.columns.positions[j]))
            qpos[:, at] = self.model.qpos0[at]
        return Rows(
            time=time,
            label=label,
            qpos=qpos,
            qvel=block(self.columns.qvel),
            ctrl=block(self.columns.ctrl),
            sensors=sensors,
        )

    def _check_held(self, table: Table) -> None:
        """Refuses a base that was not held where the model has it."""
        pose = _poses(table, self.columns.held[:FREE_WIDTH], self.mapping)
        if pose is None:
            return
        b = held_body(self.model)
        far = np.linalg.norm(pose[:, :3] - self.model.body_pos[b], axis=1).max()
        turn = np.abs(pose[:, 3:] @ self.model.body_quat[b])
        angle = 2 * np.arccos(np.clip(turn, 0, 1)).max()
        if far > _HELD_WITHIN or angle > _HELD_WITHIN:
            raise UserError(
                f"{self.path}: the base is up to {far:.2g} m and {angle:.2g} rad from "
                "where --held-base holds it: leave that out, or give logs of one pose"
            )
        self.note("columns of the held base are not read")

    def _recording(
        self, name: str, raw: Rows, rows: np.ndarray, good: np.ndarray
    ) -> list[Run]:
        """The runs of one recording: ``rows`` of the file, ``good`` the usable."""
        timed = rows[np.isfinite(raw.time[rows])]
        if len(timed) < 2:
            self.note(f"{name} left out: it has a single row")
            return []
        with np.errstate(over="ignore"):
            gaps = np.diff(raw.time[timed])
        again = log_checks.repeated_stamps(raw.time[timed])
        if len(again):
            self.note(
                f"{name}: rows dropped whose time stamp repeats that of the row "
                f"before: {len(again)} (the first is row {timed[again[0]] + 1})"
            )
            kept = np.isin(rows, timed[again], invert=True)
            return self._recording(name, raw, rows[kept], good[kept])
        back = np.flatnonzero(gaps <= 0)
        if len(back):
            a, b = timed[back[0]], timed[back[0] + 1]
            still = int(np.sum(gaps == 0))
            if still == len(back):
                raise UserError(
                    f"{self.path}: {still} of {len(timed)} rows repeat the time stamp "
                    f"of the row before (the first is row {b + 1}): the clock is "
                    "coarser than the rows; log finer stamps"
                )
            raise UserError(
                f"{self.path}: time goes back or stands still from row {a + 1} "
                f"({raw.time[a]:.13g} s) to row {b + 1}, by {-gaps[back[0]]:.3g} s; "
                'several recordings in one file need a "run" column, stamps of one '
                "clock a log that is sorted by them"
            )
        # nine digits: equal rates stay equal under the rounding of time stamps
        dt = float(f"{np.median(gaps):.9g}")
        rate_note = log_checks.rate(
            self.path, dt, self.model.opt.timestep, bool(np.all(gaps == 1))
        )
        if rate_note:
            self.note(rate_note)
        # a piece ends before every row that cannot follow the one before it
        time = raw.time[rows]
        with np.errstate(over="ignore", invalid="ignore"):
            follows = np.diff(time) <= dt * (HOLE_STEPS + EVEN)
        follows &= good[1:] & good[:-1]
        pieces = np.split(np.arange(len(rows)), np.flatnonzero(~follows) + 1)
        pieces = [piece for piece in pieces if good[piece[0]]]
        holes = int(np.sum(good[1:] & good[:-1] & ~follows))
        if holes:
            self.note(f"{name}: holes longer than {HOLE_STEPS:.0f} steps: {holes}")
        hidden = joint_dofs(self.model, self.hidden)
        given = np.isfinite(raw.qvel[rows[good]][:, ~hidden])
        measured = bool(given.size) and bool((given.mean(0) >= _GIVEN).all())
        runs: list[Run] = []
        single = sum(len(piece) < 2 for piece in pieces)
        for piece in pieces:
            if len(piece) >= 2:
                suffix = f"#{len(runs) + 1}" if len(pieces) - single > 1 else ""
                part = raw.take(rows[piece])
                run = self._run(name + suffix, part, dt, measured)
                if len(run) < 2:  # rows closer than a step
                    single += 1
                else:
                    runs.append(run)
        if single:
            self.note(f"{name}: rows left out because alone between holes: {single}")
        if len(runs) > 1:
            self.note(f"{name} split into {len(runs)} runs")
        return runs

    def _run(self, name: str, rows: Rows, dt: float, measured: bool) -> Run:
        """A run; ``measured``: whether velocities of its recording are."""
        stamps = sent = None
        if not is_even(rows.time, dt):
            stamps, held = rows.time, rows.ctrl
            worst = float(np.abs(np.diff(rows.time) / dt - 1).max())
            self.uneven.append((worst, name))
            rows = resampled(rows, dt, self.configuration)
            sent = mean_held(stamps, held, rows.time, dt)
        fitted = fitted_velocity(rows.qpos, dt, self.configuration)
        for text in log_checks.units_of_motion(
            self.model, rows.qpos, rows.qvel, rows.ctrl, fitted
        ):
            self.note(text)
        given = np.isfinite(rows.qvel)
        hidden = joint_dofs(self.model, self.hidden)
        columns_given = given.any(0)
        lacking = int(np.sum(~given[:, columns_given].all(1)))
        if lacking:
            so = "" if measured else ", and no velocity counts as measured"
            self.note(f"{name}: velocities missing in {lacking} rows are estimated{so}")
        run = Run(
            name=name,
            source=str(self.path),
            dt=dt,
            time=rows.time,
            qpos=rows.qpos,
            qvel=np.where(given, rows.qvel, fitted),
            qvel_measured=measured,
            ctrl=rows.ctrl,
            configuration=self.configuration,
            sensors=rows.sensors,
            stamps=stamps,
            sent=sent,
            hidden=hidden,
        )
        return with_guess(self.model, run)


def _names(m: mujoco.MjModel, joints: Iterable[int]) -> str:
    return ", ".join(given_name(m, j) for j in joints)


__all__ = ["Log", "Run", "read_logs", "write_log"]
