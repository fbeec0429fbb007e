"""A trained policy as ONNX and as StableHLO, its normalizer and action map inside.

Both take observations ``(batch, obs_size)`` and return ``action`` in [-1, 1], and,
where the environment says how, ``ctrl``, what the actuators are sent.
"""

import dataclasses
import importlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from easi_jax.errors import UserError, nearest
from easi_jax.io.files import to_json
from easi_jax.rl.networks import PolicyParams, act
from easi_jax.simulation.action_map import ActionMap

_OPSET = 17
_PRODUCER = "easi-jax"


@dataclass(frozen=True)
class Interface:
    """What a policy reads and writes, for those who have only the exported file.

    Attributes:
        robot: name.
        dt: control step [s].
        observation: names of the observation's entries.
        action: names of the action's.
        ctrl: names of the actuators; empty where only the action is known.
    """

    robot: str
    dt: float
    observation: tuple[str, ...]
    action: tuple[str, ...]
    ctrl: tuple[str, ...] = ()


def interface_of(env: Any) -> Interface:
    """An environment's; entries that it does not name are numbered."""
    m = env.mj_model
    names = tuple(getattr(env, "obs_names", ()))
    if len(names) != env.obs_size:
        names = tuple(f"observation.{i}" for i in range(env.obs_size))
    drives = tuple(m.actuator(i).name or f"actuator.{i}" for i in range(m.nu))
    same = env.action_size == m.nu
    action = drives if same else tuple(f"action.{i}" for i in range(env.action_size))
    mapped = getattr(env, "action_map", None) is not None
    return Interface(env.name, env.dt, names, action, drives if mapped else ())


def to_onnx(
    policy: PolicyParams, interface: Interface, action_map: ActionMap | None = None
) -> bytes:
    """The deterministic policy as an ONNX file.

    Raises:
        UserError: the package ``onnx`` is missing.
    """
    onnx, helper = _onnx("helper")
    numpy_helper = _onnx("numpy_helper")[1]
    constants, nodes = [], []

    def constant(name: str, value: Any) -> str:
        array = np.asarray(value)
        if array.dtype.kind == "f":
            array = array.astype(np.float32)
        constants.append(numpy_helper.from_array(array, name))
        return name

    def node(kind: str, inputs: Sequence[str], name: str, **given: Any) -> str:
        nodes.append(helper.make_node(kind, list(inputs), [name], name, **given))
        return name

    x = node("Sub", ["observation", constant("mean", policy.mean)], "centered")
    x = node("Div", [x, constant("std", policy.std)], "standardized")
    layers = policy.network["params"]
    for i in range(len(layers)):
        layer = layers[f"hidden_{i}"]
        kernel = np.asarray(layer["kernel"])
        bias = np.asarray(layer["bias"])
        last = i == len(layers) - 1
        if last:  # the mode of the tanh-normal: its scales are not needed
            kernel, bias = (a[..., : a.shape[-1] // 2] for a in (kernel, bias))
        weights = [constant(f"kernel{i}", kernel), constant(f"bias{i}", bias)]
        x = node("Gemm", [x, *weights], f"layer{i}")
        if not last:
            x = node("Relu", [x], f"relu{i}")
    outputs = [node("Tanh", [x], "action")]
    if action_map is not None:
        outputs.append(_mapped(action_map, node, constant))
    size = {"action": len(interface.action), "ctrl": len(interface.ctrl)}
    graph = helper.make_graph(
        nodes,
        interface.robot,
        [_tensor(helper, onnx, "observation", len(interface.observation))],
        [_tensor(helper, onnx, name, size[name]) for name in outputs],
        constants,
    )
    opset = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(graph, opset_imports=opset, producer_name=_PRODUCER)
    model.ir_version = 8  # of that opset; older runtimes read it
    helper.set_model_props(
        model, {k: json.dumps(v) for k, v in dataclasses.asdict(interface).items()}
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def from_onnx(content: bytes, name: str) -> tuple[PolicyParams, Interface]:
    """The policy that `to_onnx` wrote, whose mode alone it holds, and its interface.

    Args:
        content: of the file ``name``.

    Raises:
        UserError: not one of ours; the package ``onnx`` is missing.
    """
    onnx, numpy_helper = _onnx("numpy_helper")
    other = UserError(f"{name} is not a policy that train.export wrote as ONNX")
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # what protobuf raises has no common class
        raise other from error
    known = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}
    told = {p.key: p.value for p in model.metadata_props}
    fields = {f.name for f in dataclasses.fields(Interface)}
    layers = sum(key.startswith("kernel") for key in known)
    parts = {f"{what}{i}" for what in ("kernel", "bias") for i in range(layers)}
    whole = layers and {"mean", "std", *parts} <= known.keys() and fields <= told.keys()
    if model.producer_name != _PRODUCER or not whole:
        raise other
    network = {}
    for i in range(layers):
        layer = {what: known[f"{what}{i}"] for what in ("kernel", "bias")}
        if i == layers - 1:  # the scales of actions, which the mode has no use for
            layer = {k: np.concatenate([x, 0 * x], -1) for k, x in layer.items()}
        network[f"hidden_{i}"] = jax.tree.map(jnp.asarray, layer)
    mean, std = jnp.asarray(known["mean"]), jnp.asarray(known["std"])
    values = {k: json.loads(told[k]) for k in fields}
    names = (tuple(values[k]) for k in ("observation", "action", "ctrl"))
    interface = Interface(str(values["robot"]), float(values["dt"]), *names)
    return PolicyParams(mean, std, {"params": network}), interface


def _onnx(part: str) -> tuple[Any, Any]:
    """The package ``onnx`` and one of its modules.

    Raises:
        UserError: it is missing.
    """
    try:
        import onnx
    except ImportError:
        raise UserError(
            "ONNX needs the package onnx: pip install easi-jax[export]"
        ) from None
    return onnx, importlib.import_module(f"onnx.{part}")


def _tensor(helper: Any, onnx: Any, name: str, size: int) -> Any:
    return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])


def _mapped(action_map: ActionMap, node: Any, constant: Any) -> str:
    x = node("Mul", ["action", constant("scale", _row(action_map.scale))], "scaled")
    x = node("Add", [x, constant("offset", _row(action_map.offset))], "moved")
    if action_map.added:
        index = constant("added", np.array(action_map.added, np.int64))
        x = node(
            "Add", [x, node("Gather", ["observation", index], "read", axis=1)], "to"
        )
    x = node("Max", [x, constant("low", _row(action_map.low))], "above")
    return node("Min", [x, constant("high", _row(action_map.high))], "ctrl")


def _row(value: Any) -> np.ndarray:
    return np.atleast_1d(np.asarray(value, np.float32))


def to_stablehlo(
    policy: PolicyParams, interface: Interface, action_map: ActionMap | None = None
) -> tuple[bytes, str]:
    """The same as `jax.export` writes it, for CPU, CUDA and TPU: the serialized program
    (read by ``jax.export.deserialize``), and its StableHLO as text."""

    def run(observation: jax.Array) -> dict[str, jax.Array]:
        action = act(policy, observation, deterministic=True)
        if action_map is None:
            return {"action": action}
        return {"action": action, "ctrl": action_map(observation, action)}

    (batch,) = jax.export.symbolic_shape("batch")
    shape = (batch, len(interface.observation))
    exported = jax.export.export(jax.jit(run), platforms=("cpu", "cuda", "tpu"))(
        jax.ShapeDtypeStruct(shape, jnp.float32)
    )
    return bytes(exported.serialize()), str(exported.mlir_module())


FORMS = ("onnx", "stablehlo")


def policy_files(
    policy: PolicyParams,
    interface: Interface,
    action_map: ActionMap | None,
    forms: Sequence[str] = FORMS,
    **told: Any,
) -> dict[str, str | bytes]:
    """Files of a policy by name: ``policy.json`` (the interface, and what is ``told``
    besides), and those of ``forms``.

    Raises:
        UserError: an unknown form; a package is missing.
    """
    for form in forms:
        if form not in FORMS:
            known = ", ".join(FORMS)
            raise UserError(f'no form "{form}" (known: {known}){nearest(form, FORMS)}')
    files: dict[str, str | bytes] = {
        "policy.json": to_json({**dataclasses.asdict(interface), **told})
    }
    if "onnx" in forms:
        files["policy.onnx"] = to_onnx(policy, interface, action_map)
    if "stablehlo" in forms:
        program, text = to_stablehlo(policy, interface, action_map)
        files |= {"policy.stablehlo": program, "policy.mlir": text}
    return files
