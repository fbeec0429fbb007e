"""Pieces of recordings start, end and count where they should."""

import jax.numpy as jnp
import numpy as np

from easi_jax.data import segments


def record(steps: int, offset: float = 0.0) -> tuple[np.ndarray, ...]:
    """Every entry tells its row: qpos = row, qvel = row / 10, ctrl = -row."""
    row = np.arange(steps, dtype=float)[:, None] + offset
    return row, row / 10, -row


def test_cut_pairs_commands_with_what_follows_them() -> None:
    s = segments.cut(*record(10), horizon=3, every=2)
    assert s is not None
    assert (s.count, s.horizon) == (4, 3)
    np.testing.assert_array_equal(s.qpos[:, 0], [0, 2, 4, 6])
    np.testing.assert_array_equal(s.ctrl[1, :, 0], [-2, -3, -4])
    np.testing.assert_array_equal(s.next_qpos[1, :, 0], [3, 4, 5])
    np.testing.assert_allclose(s.next_qvel[3, :, 0], [0.7, 0.8, 0.9])
    # The last row is an end and never a start.
    assert s.next_qpos.max() == 9 and s.qpos.max() == 6


def test_the_shortest_recording_that_can_be_cut() -> None:
    assert segments.cut(*record(3), horizon=3, every=1) is None
    one = segments.cut(*record(4), horizon=3, every=1)
    assert one is not None and one.count == 1


def test_join_and_take() -> None:
    a = segments.cut(*record(6), horizon=2, every=2)
    b = segments.cut(*record(5, 100.0), horizon=2, every=1)
    assert a is not None and b is not None
    both = segments.join([a, b])
    np.testing.assert_array_equal(both.qpos[:, 0], [0, 2, 100, 101, 102])
    some = segments.to_device(both).take(jnp.array([4, 0]))
    assert some.qpos.dtype == jnp.float32
    np.testing.assert_array_equal(some.next_qpos[..., 0], [[103, 104], [1, 2]])


def test_spread_picks_at_even_distances_among_those_that_count() -> None:
    s = segments.cut(*record(12), horizon=1, every=1)
    assert s is not None and s.count == 11
    s = segments.to_device(s.replace(weight=np.array([0.0, 1] * 5 + [1])))  # type: ignore[attr-defined]
    some = s.spread(3)
    np.testing.assert_array_equal(some.qpos[:, 0], [1, 5, 9])
    np.testing.assert_array_equal(some.weight, [1, 1, 1])
    # Too few: all of them, once.
    many = s.spread(9)
    counted = np.asarray(many.qpos[:, 0])[np.asarray(many.weight) > 0]
    assert sorted(counted) == [1, 3, 5, 7, 9, 10]
    none = s.replace(weight=0 * s.weight).spread(2)  # type: ignore[attr-defined]
    assert float(none.weight.sum()) == 0


def test_windows_of_trajectories_count_only_where_all_their_steps_do() -> None:
    b, t = 2, 7
    row = jnp.arange(t, dtype=float) + 10 * jnp.arange(b)[:, None]
    weight = jnp.ones((b, t)).at[1, 4:].set(0.0)
    single = segments.Segments(
        qpos=row[..., None],
        qvel=row[..., None],
        ctrl=-row[..., None, None],
        next_qpos=row[..., None, None] + 1,
        next_qvel=row[..., None, None] + 1,
        weight=weight,
    )
    w = segments.windows(single, horizon=3, every=2)
    np.testing.assert_array_equal(w.qpos[:, 0], [0, 2, 4, 10, 12, 14])
    np.testing.assert_array_equal(w.ctrl[1, :, 0], [-2, -3, -4])
    np.testing.assert_array_equal(w.next_qvel[4, :, 0], [13, 14, 15])
    np.testing.assert_array_equal(w.weight, [1, 1, 1, 1, 0, 0])


def test_pieces_of_trajectories_know_what_was_sent_before() -> None:
    """As pieces of logs do; before the first command it was that command."""
    rng = np.random.default_rng(0)
    qpos, ctrl = rng.normal(size=(2, 9, 2)), rng.normal(size=(2, 8, 1))
    trajectories = segments.Segments(
        qpos=qpos[:, :-1],
        qvel=qpos[:, :-1],
        ctrl=ctrl[:, :, None],
        next_qpos=qpos[:, 1:, None],
        next_qvel=qpos[:, 1:, None],
        weight=np.ones((2, 8)),
    )
    logs = [
        segments.cut(q, q, np.concatenate([c, c[-1:]]), 3, 2, past=2)
        for q, c in zip(qpos, ctrl, strict=True)
    ]
    expected = segments.join([x for x in logs if x is not None])
    got = segments.windows(trajectories, 3, 2, past=2)
    for name in ("qpos", "ctrl", "next_qpos", "past", "weight"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert segments.windows(trajectories, 3, 2).past == ()
