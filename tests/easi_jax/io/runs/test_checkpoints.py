import errno
import json
import os
import resource
from pathlib import Path
from typing import Any, NamedTuple

import evosax.algorithms
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from benchmarks.fuzz_readers import reseal
from easi_jax.errors import UserError
from easi_jax.io.runs import checkpoints


class State(NamedTuple):
    params: dict[str, jax.Array]
    optimizer: Any
    evolution: Any
    keys: jax.Array
    step: jax.Array
    nothing: jax.Array
    half: jax.Array


def _state(seed=0):
    key = jax.random.key(seed)
    params = {"w": jax.random.normal(key, (3, 2)), "b": jnp.zeros(2)}
    es = evosax.algorithms.SimpleES(population_size=4, solution=jnp.zeros(2))
    return State(
        params=params,
        optimizer=optax.adam(1e-3).init(params),
        evolution=es.init(key, jnp.ones(2), es.default_params),
        keys=jax.random.split(key, 3),
        step=jnp.int32(seed),
        nothing=jnp.zeros((0, 4)),
        half=jnp.full(2, 1 / 3, jnp.bfloat16),
    )


@pytest.fixture(scope="module")
def states():
    return [_state(i) for i in range(4)]


@pytest.fixture(scope="module")
def target():
    return jax.eval_shape(_state)


def _bits(tree):
    def raw(x):
        x = (
            jax.random.key_data(x)
            if jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
            else x
        )
        return np.asarray(x).dtype, np.asarray(x).tobytes()

    return [raw(x) for x in jax.tree.leaves(tree)]


def _assert_same(found, wanted):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    assert _bits(found) == _bits(wanted)


def test_any_state_comes_back_bit_equal(tmp_path, states, target):
    checkpoints.save(tmp_path, 7, states[1], config_hash="a")
    found = checkpoints.restore(tmp_path, target, config_hash="a")
    assert found is not None
    assert found.step == 7
    assert found.notes == ()
    _assert_same(found.state, states[1])
    a, b = (jax.random.uniform(s.keys[0], (2,)) for s in (found.state, states[1]))
    np.testing.assert_array_equal(a, b)


def test_keeps_the_newest_two_and_replaces_a_step(tmp_path, states, target):
    for step in (1, 9, 10):
        checkpoints.save(tmp_path, step, states[0], config_hash="a")
    assert checkpoints.steps(tmp_path) == [9, 10]
    checkpoints.save(tmp_path, 10, states[2], config_hash="a")
    found = checkpoints.restore(tmp_path, target)
    assert found is not None
    _assert_same(found.state, states[2])
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_nothing_there_is_none(tmp_path, target):
    assert checkpoints.restore(tmp_path, target) is None
    assert checkpoints.restore(tmp_path / "missing", target) is None


def _largest(path):
    files = [p for p in (path / "state").rglob("*") if p.is_file()]
    return max(files, key=lambda p: p.stat().st_size)


def _cut(path):
    file = _largest(path)
    file.write_bytes(file.read_bytes()[:-5])


def _flip(path):
    file = _largest(path)
    raw = bytearray(file.read_bytes())
    raw[len(raw) // 2] ^= 1
    file.write_bytes(raw)


def _lose_file(path):
    next(p for p in (path / "state").rglob("*") if p.is_file()).unlink()


def _lose_meta(path):
    (path / "meta.json").unlink()


def _cut_meta(path):
    (path / "meta.json").write_bytes((path / "meta.json").read_bytes()[:40])


def _other_format(path):
    meta = json.loads((path / "meta.json").read_text())
    (path / "meta.json").write_text(json.dumps({**meta, "format": 99}))


def _no_mapping(path):
    (path / "meta.json").write_text("[]")


def _odd_leaves(path):
    meta = json.loads((path / "meta.json").read_text())
    (path / "meta.json").write_text(json.dumps({**meta, "leaves": [[]]}))


def _edited_with_digests(path):
    """As by somebody who edits the files and their digests."""
    _cut(path)
    reseal(path)


def _link(path):
    file = _largest(path)
    other = path.parent / "elsewhere"
    other.write_bytes(file.read_bytes())
    file.unlink()
    file.symlink_to(other)


def _pipe(path):
    (path / "meta.json").unlink()
    os.mkfifo(path / "meta.json")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_cut, "cut short or damaged"),
        (_flip, "cut short or damaged"),
        (_lose_file, "cut short or damaged"),
        (_lose_meta, "cut short or damaged"),
        (_cut_meta, "cut short or damaged"),
        (_other_format, "format 99, this version reads 1"),
        (_no_mapping, "cut short or damaged"),
        (_odd_leaves, "cut short or damaged"),
        (_edited_with_digests, "damaged ("),
        (_link, "is no file"),
        (_pipe, "cut short or damaged"),
    ],
)
@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_damaged_checkpoint_falls_back_then_refuses(
    tmp_path, states, target, damage, said
):
    first = checkpoints.save(tmp_path, 1, states[1], config_hash="a")
    second = checkpoints.save(tmp_path, 2, states[2], config_hash="a")
    damage(second)
    found = checkpoints.restore(tmp_path, target)
    assert found is not None
    assert found.step == 1
    (note,) = found.notes
    assert note.startswith(f"checkpoint {second} is unusable: ")
    assert said in note
    _assert_same(found.state, states[1])
    damage(first)
    with pytest.raises(UserError) as error:
        checkpoints.restore(tmp_path, target)
    assert str(second) in str(error.value)
    assert said in str(error.value)
    assert "--overwrite" in str(error.value)


def test_other_configuration_is_refused(tmp_path, states, target):
    checkpoints.save(tmp_path, 1, states[1], config_hash="a")
    with pytest.raises(UserError, match="another configuration"):
        checkpoints.restore(tmp_path, target, config_hash="b")


@pytest.mark.fault("damaged or edited checkpoint, result or configuration")
def test_other_shape_dtype_or_structure_is_named(tmp_path, target):
    checkpoints.save(tmp_path, 1, {"w": jnp.zeros((3, 2))}, config_hash="a")

    def refused(other, said):
        with pytest.raises(UserError, match=said):
            checkpoints.restore(tmp_path, other)

    refused(
        {"w": jnp.zeros((3, 4))}, r"w is float32\[3, 2\], needed .* float32\[3, 4\]"
    )
    refused({"w": jnp.zeros((3, 2), jnp.int32)}, r"needed is 0000-w int32")
    refused({"v": jnp.zeros((3, 2))}, r"0000-w is .* needed is 0000-v")
    refused({"w": jnp.zeros((3, 2)), "x": jnp.zeros(1)}, "1 arrays, needed are 2")


def test_restores_onto_the_sharding_of_the_target(tmp_path):
    mesh = jax.make_mesh((len(jax.devices()),), ("i",))
    spec = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("i"))
    value = jax.device_put(jnp.arange(4.0 * mesh.size), spec)
    checkpoints.save(tmp_path, 1, value, config_hash="a")
    found = checkpoints.restore(
        tmp_path, jax.ShapeDtypeStruct(value.shape, value.dtype, sharding=spec)
    )
    assert found is not None
    assert found.state.sharding == spec
    np.testing.assert_array_equal(found.state, value)


@pytest.mark.fault("disk full, folder read-only")
def test_full_disk_keeps_the_last_good_one(tmp_path, states, target):
    checkpoints.save(tmp_path, 1, states[1], config_hash="a")
    noise = np.random.default_rng(0).normal(size=5000)
    big = {"buffer": noise.astype(np.float32)}
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limit[1]))
    try:
        with pytest.raises(
            UserError, match=r"cannot write checkpoint .*step 1 is kept"
        ):
            checkpoints.save(tmp_path, 2, big, config_hash="a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert [p.name for p in tmp_path.iterdir()] == ["step_000000000001"]
    found = checkpoints.restore(tmp_path, target)
    assert found is not None
    _assert_same(found.state, states[1])


@pytest.mark.parametrize("failing", ["rename", "mkdir", "fsync"])
@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EROFS])
@pytest.mark.fault("disk full, folder read-only")
def test_failure_at_any_point_keeps_the_same_step(
    tmp_path, states, target, monkeypatch, failing, reason
):
    """Also where the step that is written again has been moved aside already."""
    checkpoints.save(tmp_path, 1, states[1], config_hash="a")
    owner = os if failing == "fsync" else Path
    plain = getattr(owner, failing)

    def fails(first, *args, **kwargs):
        if failing != "rename" or ".writing" in str(first):
            raise OSError(reason, os.strerror(reason))
        return plain(first, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(owner, failing, fails)
        with pytest.raises(UserError) as error:
            checkpoints.save(tmp_path, 1, states[2], config_hash="a")
    assert os.strerror(reason) in str(error.value)
    assert "the one of step 1 is kept" in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == ["step_000000000001"]
    found = checkpoints.restore(tmp_path, target)
    assert found is not None
    _assert_same(found.state, states[1])


def test_a_file_where_the_folder_should_be(tmp_path, states):
    (tmp_path / "checkpoints").write_text("")
    with pytest.raises(UserError, match=r"cannot write checkpoint .*none is kept yet"):
        checkpoints.save(tmp_path / "checkpoints", 1, states[0], config_hash="a")


def test_names_that_only_look_like_steps(tmp_path, states):
    for name in ("step_²", "step_x", "step_"):
        (tmp_path / name).mkdir()
    assert checkpoints.steps(tmp_path) == []
    checkpoints.save(tmp_path, 3, states[0], config_hash="a")
    assert checkpoints.steps(tmp_path) == [3]


@pytest.mark.fault("killed (signal 9), then resumed")
def test_leftovers_of_a_killed_process_are_cleaned(tmp_path, states):
    (tmp_path / ".writing-1" / "state").mkdir(parents=True)
    checkpoints.save(tmp_path, 3, states[0], config_hash="a")
    assert [p.name for p in tmp_path.iterdir()] == ["step_000000000003"]


@pytest.mark.fault("killed (signal 9), then resumed")
def test_killed_between_two_renames(tmp_path, states, target):
    """A step that is written again lies aside for a moment."""
    checkpoints.save(tmp_path, 3, states[1], config_hash="a")
    (tmp_path / "step_000000000003").rename(tmp_path / ".old-000000000003")
    (tmp_path / ".writing-1").mkdir()
    assert checkpoints.steps(tmp_path) == [3]
    found = checkpoints.restore(tmp_path, target)
    assert found is not None and found.step == 3
    _assert_same(found.state, states[1])
    checkpoints.save(tmp_path, 4, states[2], config_hash="a")
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        *("step_000000000003", "step_000000000004"),
    ]
    checkpoints.save(tmp_path, 3, states[0], config_hash="a")
    assert checkpoints.steps(tmp_path) == [3, 4]
