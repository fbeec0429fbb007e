"""Readies jax before its backend starts. Imported first by ``easi_jax``.

Everything here is a default: what the environment or an earlier
``jax.config.update`` has set is left alone. ``status()`` says what is in force.
"""

import contextlib
import io
import logging
import os
from pathlib import Path
from typing import Any

_MIN_POOL = 8
_EMITTERS = "xla_cpu_use_fusion_emitters"
_LEVEL = "xla_backend_optimization_level"
_WAIT = 10**7  # s
_EXTRA = "xla_backend_extra_options"
_NEXT = (0, 13)  # first jaxlib that these were not tried with
# Bytes that a loop may touch and still run as one piece; beyond, compiling takes long.
_LOOPS, _LARGER = (
    f"xla_cpu_small_while_loop_byte_threshold={n}" for n in (2_000_000, 8_000_000)
)
# An unknown flag ends the process: each only up to the jaxlib that is known to have it.
_FLAGS: dict[str, tuple[object, tuple[int, int]]] = {
    _EMITTERS: ("false", (0, 11)),
    _EXTRA: (_LOOPS, _NEXT),
    "xla_cpu_collective_call_warn_stuck_timeout_seconds": (_WAIT, _NEXT),
    "xla_cpu_collective_call_terminate_timeout_seconds": (_WAIT, _NEXT),
}
_state: dict[str, object] = {}


def cores() -> int:
    """CPU cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        return os.cpu_count() or 1


def backend_started() -> bool:
    """True once jax has initialised a backend, after which nothing can be set."""
    from jax._src import xla_bridge

    return bool(xla_bridge.backends_are_initialized())


def on_cpu() -> bool:
    """Whether programs run on CPU cores; starts the backend."""
    import jax

    return jax.default_backend() == "cpu"


def _setting(name: str) -> Any:
    import jax

    return getattr(jax.config, name)


def cache_dir() -> Path:
    """Folder of the persistent compilation cache."""
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "easi-jax" / "xla"


def prepare() -> dict[str, object]:
    """Sets what must be set before jax starts its backend; safe to call again.

    - ``NPROC``: jaxlib's intra-op pool must be larger than the number of cores,
      or a batched Cholesky of a few hundred matrices can wait for itself for ever.
    - one CPU device per core, so that a mesh over them uses all of them;
    - XLA's older loop emitters, which compile faster; what simulates for long asks for
      the newer ones by `fast_loops` (measured with jaxlib 0.10.2);
    - loops that touch up to 2 MB become one function, in place of a call for each
      operation of each round (a cart-pole is simulated five times as fast);
    - CPU devices wait for each other as long as it takes: XLA ends the process after a
      minute, but a device without a seed of its own waits for a chunk of training;
    - persistent compilation cache;
    - full float32 products on GPUs that would use TF32;
    - quiet imports of mujoco.mjx where warp is missing.
    """
    if _state:
        return _state
    if not os.environ.get("NPROC"):
        os.environ["NPROC"] = str(max(_MIN_POOL, 4 * cores()))
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    late = backend_started()
    if not late:
        _ready_flags(jax.__version_info__)
        flags = os.environ.get("XLA_FLAGS", "")
        own_count = (
            "JAX_NUM_CPU_DEVICES" in os.environ
            or "xla_force_host_platform_device_count" in flags
        )
        if not own_count and _setting("jax_num_cpu_devices") == -1:
            jax.config.update("jax_num_cpu_devices", cores())
        if _setting("jax_default_matmul_precision") is None:
            jax.config.update("jax_default_matmul_precision", "highest")
        _ready_cache()
    with contextlib.redirect_stdout(io.StringIO()):
        logging.getLogger("jax._src.xla_bridge").setLevel(logging.ERROR)
        from mujoco import mjx  # noqa: F401  prints two lines without warp
    _state.update(late=late)
    return _state


def _ready_flags(version: tuple[int, ...]) -> None:
    flags = os.environ.get("XLA_FLAGS", "")
    for name, (value, _) in _FLAGS.items():
        if name not in flags and _known(name, version):
            flags = f"{flags} --{name}={value}".strip()
    if flags:
        os.environ["XLA_FLAGS"] = flags


def larger_loops() -> None:
    """Loops that touch up to 8 MB become one function as well.

    For a process that simulates one machine for minutes: an arm of six joints is then
    predicted about three times as fast, which takes a minute more to compile (jaxlib
    0.10.2, tried by hand; the whole: benchmarks/gap_times.py). Nothing changes where a
    backend has started, or where the environment says otherwise.
    """
    prepare()
    if not backend_started():
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = flags.replace(_LOOPS, _LARGER)


def fast_loops() -> dict[str, Any]:
    """``compiler_options`` of ``jax.jit`` for programs that simulate for long.

    They take longer to compile and, on CPU, simulate about twice as fast; from jaxlib
    0.11 on there are no others. Empty where the environment says how far to optimize.
    """
    import jax

    own = _level_chosen() or not _known(_EMITTERS, jax.__version_info__)
    return {} if own else {_EMITTERS: True}


def quick_compile() -> dict[str, Any]:
    """``compiler_options`` of ``jax.jit`` where compiling takes as long as running.

    On CPU, LLVM then does less: half the time to compile, and simulations as fast as
    before (measured with jaxlib 0.10.2: predictions of a cart-pole, 30.3 and 29.2 s,
    with `fast_loops` 18.8 and 18.7 s). Empty where the environment says how far to
    optimize.
    """
    return {_LEVEL: 1} if on_cpu() and not _level_chosen() else {}


def _level_chosen() -> bool:
    return _LEVEL in os.environ.get("XLA_FLAGS", "")


def _known(flag: str, version: tuple[int, ...]) -> bool:
    return (0, 10) <= version < _FLAGS[flag][1]


def _ready_cache() -> None:
    import jax

    if _setting("jax_compilation_cache_dir") is None:
        path = cache_dir()
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError:  # a read-only home: run without, `train.info` shows it
            return
        jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def status() -> dict[str, object]:
    """What is in force now, for ``python -m train.info`` and for run folders."""
    import jax

    prepare()
    pool = int(os.environ.get("NPROC", "0") or 0)
    devices = jax.devices()
    return {
        "cores": cores(),
        "nproc": pool,
        "deadlock_cure": pool > cores() and not _state["late"],
        "platform": devices[0].platform,
        "device_kind": devices[0].device_kind,
        "devices": len(devices),
        "one_device_per_core": devices[0].platform != "cpu" or len(devices) == cores(),
        "compilation_cache": _setting("jax_compilation_cache_dir"),
        "quick_compile": f"{_EMITTERS}=false" in os.environ.get("XLA_FLAGS", ""),
        "loops_in_one_piece": any(
            loops in os.environ.get("XLA_FLAGS", "") for loops in (_LOOPS, _LARGER)
        ),
        "matmul_precision": _setting("jax_default_matmul_precision"),
        "x64": bool(_setting("jax_enable_x64")),
        "prepared_before_backend": not _state["late"],
    }
