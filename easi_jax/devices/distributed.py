"""One run on several processes, as on several hosts, by ``jax.distributed``.

Every process runs the same command and keeps in step with the others; its devices are
a part of one mesh. Process 0, the leader, reads and writes the run's files and prints.
Between programs arrays live on each process by themselves (`local`); inside they are
spread over, or the same on, all devices.
"""

import os
import pickle
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

from easi_jax.errors import UserError

T = TypeVar("T")

HEARTBEAT = 20  # s without a sign of life after which a process counts as dead
PORT = 8476
_index, _count = 0, 1

# Number of processes, own number, number on this host, processes on this host.
_LAUNCHERS = (
    ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID", "", ""),
    ("JAX_NUM_PROCESSES", "JOB_COMPLETION_INDEX", "", ""),  # a Kubernetes indexed job
    (
        "SLURM_STEP_NUM_TASKS",
        "SLURM_PROCID",
        "SLURM_LOCALID",
        "SLURM_STEP_TASKS_PER_NODE",
    ),
    (
        "OMPI_COMM_WORLD_SIZE",
        "OMPI_COMM_WORLD_RANK",
        "OMPI_COMM_WORLD_LOCAL_RANK",
        "OMPI_COMM_WORLD_LOCAL_SIZE",
    ),
    ("PMI_SIZE", "PMI_RANK", "MPI_LOCALRANKID", "MPI_LOCALNRANKS"),  # MPICH, Intel MPI
    ("WORLD_SIZE", "RANK", "LOCAL_RANK", "LOCAL_WORLD_SIZE"),  # torchrun, Kubeflow
)


class Place(NamedTuple):
    """Where a process stands among the others.

    Attributes:
        address: ``host:port`` of process 0.
        count: processes.
        index: of this one.
        devices: of this host that are its own; None for all.
    """

    address: str
    count: int
    index: int
    devices: tuple[int, ...] | None


def find_place(env: Mapping[str, str]) -> Place:
    """What Slurm, Kubernetes, mpirun or a person has said in the environment.

    Raises:
        UserError: nothing there, or it contradicts itself.
    """
    for names in _LAUNCHERS:
        if env.get(names[0]) and env.get(names[1]):
            break
    else:
        raise UserError(
            "--distributed finds no other processes: start it with srun or mpirun, or "
            "set JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID"
        )
    count, index = _number(env, names[0]), _number(env, names[1])
    if not 0 <= index < count:
        raise UserError(f"{names[1]}={index} is not below {names[0]}={count}")
    local, beside = env.get(names[2], "0"), env.get(names[3], "1")
    # "2(x3),1": two tasks on each of three nodes, one on the fourth.
    several = any(int(n) > 1 for n in re.findall(r"(?<![\dx])\d+", beside))
    shown = [x for x in env.get("CUDA_VISIBLE_DEVICES", "").split(",") if x]
    own = (int(local),) if several and len(shown) != 1 else None
    return Place(_address(env, names, count), count, index, own)


def _number(env: Mapping[str, str], name: str) -> int:
    if not env[name].isdigit():
        raise UserError(f"{name}={env[name]}: it must be a whole number")
    return int(env[name])


def _address(env: Mapping[str, str], names: tuple[str, ...], count: int) -> str:
    given = env.get("JAX_COORDINATOR_ADDRESS") or env.get("MASTER_ADDR")
    nodes = env.get("SLURM_STEP_NODELIST")
    if given:
        port = env.get("MASTER_PORT", PORT)
        return given if re.search(r":\d+$", given) else f"{given}:{port}"
    if nodes and names[1] == "SLURM_PROCID":
        # The first of "node7", "node7,node9" or "node[007-009,12]"; a job's own port.
        first = re.match(r"([^,\[]+)(?:\[([^],-]+))?", nodes)
        assert first is not None
        port = 61440 + int(env.get("SLURM_JOB_ID", "0")) % 4096
        return f"{first[1]}{first[2] or ''}:{port}"
    if count == 1:
        return f"127.0.0.1:{PORT}"
    raise UserError(
        f"{names[0]}={count}, but nothing says where process 0 is: set "
        "JAX_COORDINATOR_ADDRESS=HOST:PORT on every process (mpirun -x ...)"
    )


def start(wait: int = 300) -> None:
    """Joins the other processes; before jax starts its backend.

    Args:
        wait: for the others, at most [s].

    Raises:
        UserError: see `find_place`, or the others cannot be reached.
    """
    global _index, _count
    place = find_place(os.environ)
    if place.count == 1:
        return
    import jax

    # It would take SIGTERM for itself, which tells a command to stop.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            coordinator_address=place.address,
            num_processes=place.count,
            process_id=place.index,
            local_device_ids=place.devices,
            cluster_detection_method="deactivate",
            initialization_timeout=wait,
            heartbeat_timeout_seconds=HEARTBEAT,
        )
    except RuntimeError as error:
        raise UserError(
            f"process {place.index} of {place.count} cannot meet the others at "
            f"{place.address}: {str(error).splitlines()[0]}"
        ) from error
    _index, _count = place.index, place.count


def stop() -> None:
    """Waits for the others to be done, and parts from them."""
    global _index, _count
    if _count > 1:
        import jax

        jax.distributed.shutdown()
        _index, _count = 0, 1


def count() -> int:
    """Processes of this run."""
    return _count


def leader() -> bool:
    """Whether this process reads and writes the run's files and prints."""
    return _index == 0


def from_leader(fun: Callable[[], T]) -> T:
    """What ``fun`` returns in the leader, or the UserError that it raises there.

    The others do not call it. Results are arrays of numpy and what can be pickled.
    """
    if _count == 1:
        return fun()
    result: Any = None
    if leader():
        try:
            result = True, fun()
        except UserError as error:
            result = False, str(error)
    good, value = _broadcast(result)
    if not good:
        raise UserError(value)
    return value


def _broadcast(value: Any) -> Any:
    import numpy as np
    from jax.experimental.multihost_utils import broadcast_one_to_all

    raw = np.frombuffer(pickle.dumps(value), np.uint8) if leader() else None
    size = int(broadcast_one_to_all(np.int32(0 if raw is None else len(raw))))
    data = np.zeros(size, np.uint8) if raw is None else raw
    return pickle.loads(np.asarray(broadcast_one_to_all(data)).tobytes())


def started(work: Callable[[], T]) -> Callable[[], T]:
    """Begins ``work`` beside what follows; the function waits for its result.

    For compiling, which leaves other cores and the interpreter mostly free. Several
    processes of one run must begin their programs in one order, so there it is done
    at once.
    """
    if count() > 1:
        done = work()
        return lambda: done
    pool = ThreadPoolExecutor(1)
    result = pool.submit(work).result
    pool.shutdown(wait=False)
    return result


def local(tree: T) -> T:
    """Arrays of all processes, as arrays of this process alone.

    A program that closes over an array needs it so, and so does what reads its numbers.
    What is spread over the devices is gathered: every process has to call this.
    """
    if _count == 1:
        return tree
    import jax

    return jax.tree.map(lambda x: _rewrapped(x, jax.numpy.asarray), tree)


def everywhere(tree: T, sharding: Any) -> T:
    """Arrays of this process, the same in each, as arrays on all devices.

    Nothing is sent between processes, so their order does not matter.
    """
    import jax
    import numpy as np

    def spread(x: np.ndarray) -> Any:
        return jax.make_array_from_callback(x.shape, sharding, lambda i: x[i])

    def one(x: Any) -> Any:
        there = isinstance(x, jax.Array) and not x.is_fully_addressable
        return x if there else _rewrapped(x, spread)

    return jax.tree.map(one, tree)


def _rewrapped(x: Any, fun: Callable[[Any], Any]) -> Any:
    """``fun`` of the numbers of an array, which may be of keys."""
    import jax

    kind = getattr(x, "dtype", None)
    if kind is None or not jax.numpy.issubdtype(kind, jax.dtypes.prng_key):
        return fun(_whole(x))
    data = fun(_whole(jax.random.key_data(x)))
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(x))


def _whole(x: Any) -> Any:
    """The numbers of an array, gathered where other processes hold some of them."""
    import jax
    import numpy as np
    from jax.experimental.multihost_utils import process_allgather

    alone = not isinstance(x, jax.Array) or x.is_fully_addressable
    if alone or x.is_fully_replicated:
        return np.asarray(x)
    return np.asarray(process_allgather(x, tiled=True))
