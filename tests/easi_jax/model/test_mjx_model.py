"""A model with parameters written into it moves as one compiled with them."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from easi_jax.errors import UserError
from easi_jax.model.mjx_model import put_model, with_parameters

# name: (address or addresses, value written, value of the model as given or None
# where the model says nothing of it). All static gates of MJX start closed.
PARAMETERS: dict[str, tuple[Any, float, float | None]] = {
    "cart_damping": ("joint.cart.damping", 0.4, None),
    "cart_loss": ("joint.cart.frictionloss", 0.6, None),
    "cart_speed": ("joint.cart.speed_limit", 0.5, None),
    "cart_mass": ("body.cart.mass", 0.7, 0.3),
    "kp": ("actuator.cart.kp", 35.0, 20.0),
    "kv": ("actuator.cart.kv", 1.5, None),
    "limit": ("actuator.cart.force_limit", 2.0, None),
    "pole_loss": ("joint.pole.frictionloss", 0.5, None),
    "pole_armature": ("joint.pole.armature", 0.004, 0.001),
    "pole_mass": ("body.pole.mass", 0.22, 0.1),
    "pole_length": ("geom.pole.length", 0.41, 0.3),
    "stiffness": ("joint.spring.stiffness", 12.0, None),
    "springref": ("joint.spring.springref", 0.15, None),
    "wheel_kv": ("actuator.wheel.kv", 0.9, 0.5),
    "tied_damping": (("joint.spring.damping", "joint.ar*.damping"), 0.07, 0.02),
    "gain": ("actuator.arm.gain", 1.7, 1.0),
    "gear": ("actuator.arm.gear", 1.4, 1.0),
    "arm_kv": ("actuator.arm.kv", 0.2, None),
    "tau": ("actuator.lag.time_constant", 0.05, 0.02),
    "box_mass": ("body.box.mass", 2.0, 1.2),
    "com_x": ("body.box.com_x", 0.03, 0.0),
    "com_z": ("body.box.com_z", -0.02, 0.0),
    "friction": ("geom.box.friction", 0.35, 0.6),
    "contact_k": ("geom.box.contact_stiffness", 1500.0, None),
    "contact_b": ("geom.box.contact_damping", 60.0, None),
    "gravity": ("option.gravity", 7.0, 9.81),
    "viscosity": ("option.viscosity", 0.02, None),
    "density": ("option.density", 5.0, None),
}
NAMES = tuple(PARAMETERS)
VALUES = {name: p[1] for name, p in PARAMETERS.items()}
NOMINAL = {name: p[2] for name, p in PARAMETERS.items() if p[2] is not None}
DOWN = np.array([0.1, 0.0, -1.0]) / np.hypot(0.1, 1.0)
STEPS = 120


def xml(v: dict[str, float]) -> str:
    """The test machine with the values in ``v``; what is not there stays unsaid."""

    def attr(text: str, *names: str) -> str:
        if any(n not in v for n in names):
            return ""
        return text.format(*(f"{v[n]:.17g}" for n in names))

    length = v["pole_length"]
    # The pole's geom, turned 15 degrees about y: its place along its own axis scales.
    along = np.array([np.sin(np.radians(15)), 0.0, np.cos(np.radians(15))])
    pos = np.array([0.02, 0.01, 0.15])
    pos = pos + (length / 0.3 - 1) * (pos @ along) * along
    gravity = DOWN * v["gravity"]
    inertia = np.array([0.004, 0.006, 0.008]) * v["box_mass"] / 1.2

    def vector(x: Any) -> str:
        return " ".join(f"{y:.17g}" for y in x)

    return f"""<mujoco><compiler autolimits="true"/>
    <option timestep="0.002" integrator="Euler" iterations="60" ls_iterations="60"
      tolerance="1e-14" gravity="{vector(gravity)}"
      {attr('viscosity="{}"', "viscosity")} {attr('density="{}"', "density")}/>
    <worldbody>
    <geom name="floor" type="plane" size="5 5 1" friction="0.1"/>
    <body name="cart" pos="0 0 2">
      <joint name="cart" type="slide" axis="1 0 0" range="-0.2 0.2"
        {attr('damping="{}"', "cart_damping")}
        {attr('frictionloss="{}"', "cart_loss")}/>
      <geom type="box" size="0.02 0.01 0.03" mass="{v["cart_mass"]:.17g}"
        contype="0" conaffinity="0"/>
      <body name="pole"><joint name="pole" axis="0 1 0"
          armature="{v["pole_armature"]:.17g}"
          {attr('frictionloss="{}"', "pole_loss")}/>
        <geom name="pole" type="box" size="0.01 0.008 {length / 2:.17g}"
          pos="{vector(pos)}" euler="0 15 0" mass="{v["pole_mass"]:.17g}"
          contype="0" conaffinity="0"/></body></body>
    <body name="spring" pos="0 2 2"><joint name="spring" type="slide" axis="0 1 0"
        damping="{v["tied_damping"]:.17g}" {attr('stiffness="{}"', "stiffness")}
        {attr('springref="{}"', "springref")}/>
      <geom size="0.1" mass="0.5" contype="0" conaffinity="0"/></body>
    <body name="arm" pos="0 -2 2"><joint name="arm" axis="1 0 0"
        damping="{v["tied_damping"]:.17g}"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.4" mass="0.3"
        contype="0" conaffinity="0"/></body>
    <body name="box" pos="1 0 0.05"><freejoint/>
      <inertial pos="{v["com_x"]:.17g} 0 {v["com_z"]:.17g}"
        mass="{v["box_mass"]:.17g}" diaginertia="{vector(inertia)}"/>
      <geom name="box" type="box" size="0.15 0.1 0.05"
        friction="{v["friction"]:.17g}"
        {attr('solref="-{} -{}"', "contact_k", "contact_b")}/></body>
    </worldbody>
    <actuator>
      <position name="cart" joint="cart" kp="{v["kp"]:.17g}" {attr('kv="{}"', "kv")}
        {attr('forcerange="-{} {}"', "limit", "limit")}/>
      <velocity name="wheel" joint="spring" kv="{v["wheel_kv"]:.17g}"/>
      <general name="arm" joint="arm" gainprm="{v["gain"]:.17g}"
        gear="{v["gear"]:.17g}"
        {attr('biastype="affine" biasprm="0 0 -{}"', "arm_kv")}/>
      <general name="lag" joint="arm" dyntype="filterexact" gainprm="0.5"
        dynprm="{v["tau"]:.17g}"/>
    </actuator></mujoco>"""


def scene(**changes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(qpos, qvel, ctrl) from named joint values."""
    q = {"cart": 0.0, "pole": 0.0, "spring": 0.0, "arm": 0.0, "box": (1, 0, 2)}
    w = {"cart": 0.0, "pole": 0.0, "spring": 0.0, "arm": 0.0, "box": (0,) * 6}
    u = changes.pop("ctrl", (0.0, 0.0, 0.0, 0.0))
    for key, (pos, vel) in changes.items():
        q[key], w[key] = pos, vel
    quat = (1.0, 0.0, 0.0, 0.0)
    qpos = np.array([q["cart"], q["pole"], q["spring"], q["arm"], *q["box"], *quat])
    qvel = np.array([w["cart"], w["pole"], w["spring"], w["arm"], *w["box"]])
    return qpos, qvel, np.array(u)


SCENES = {
    "smooth": scene(
        cart=(-0.1, 0.3),
        pole=(0.5, 3.0),
        spring=(0.1, 1.0),
        arm=(0.3, -2.0),
        box=((1, 0, 2), (1, 0.5, 0, 3, 2, -1)),
        ctrl=(0.1, 0.5, 0.3, -0.4),
    ),
    # What drives the cart (gravity is tilted) and the pole is below dry friction.
    "stick": scene(pole=(0.3, 0.0), ctrl=(-0.012, 0, 0.1, 0.1)),
    "limit": scene(cart=(0.195, 0.45), pole=(0.2, 1.0), ctrl=(0.6, 1.0, 0, 1.0)),
    "rest": scene(box=((1, 0, 0.0502), (0, 0, 0, 0, 0, 0))),
    "slide": scene(box=((1, 0, 0.0502), (0.8, 0.3, 0, 0, 0, 1.0))),
}


def mujoco_rollout(values: dict[str, float], start: Any, speed: float) -> np.ndarray:
    m = mujoco.MjModel.from_xml_string(xml(values))
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.ctrl[:] = start
    out = []
    for _ in range(STEPS):
        mujoco.mj_step(m, d)
        d.qvel[0] = np.clip(d.qvel[0], -speed, speed)
        out.append(np.concatenate([d.qpos, d.qvel]))
    return np.array(out)


@pytest.fixture(scope="module")
def simulator() -> Any:
    """One compiled batch: all scenes at VALUES, then each parameter moved in each."""
    addresses = [(a,) if isinstance(a, str) else a for a, _, _ in PARAMETERS.values()]
    theta = np.array([VALUES[n] for n in NAMES])
    thetas = [theta]
    for i in range(len(NAMES)):
        moved = theta.copy()
        moved[i] *= 0.9
        thetas.append(moved)
    with jax.enable_x64(True):
        model = put_model(mujoco.MjModel.from_xml_string(xml(NOMINAL)), addresses)

        def rollout(t: jax.Array, qpos: jax.Array, qvel: jax.Array, u: jax.Array):
            own = with_parameters(model, t)
            d = mjx.make_data(own.mjx).replace(qpos=qpos, qvel=qvel, ctrl=u)

            def step(d: mjx.Data, _: None) -> tuple[mjx.Data, jax.Array]:
                d = mjx.step(own.mjx, d)
                qvel = jnp.clip(d.qvel, -own.speed_limit, own.speed_limit)
                d = d.replace(qvel=qvel)
                return d, jnp.concatenate([d.qpos, d.qvel])

            return jax.lax.scan(step, d, None, length=STEPS)[1]

        over_scenes = jax.vmap(rollout, (None, 0, 0, 0))
        starts = [jnp.asarray(np.stack(x)) for x in zip(*SCENES.values(), strict=True)]
        both = jax.jit(jax.vmap(over_scenes, (0, None, None, None)))
        out = np.asarray(both(jnp.asarray(np.stack(thetas)), *starts))
    return SimpleNamespace(model=model, addresses=addresses, rollouts=out)


@pytest.mark.parametrize("name", SCENES)
def test_equals_compiled_model(simulator: Any, name: str) -> None:
    """with_parameters equals MuJoCo C on an XML that says the same values."""
    got = simulator.rollouts[0, list(SCENES).index(name)]
    want = mujoco_rollout(VALUES, SCENES[name], VALUES["cart_speed"])
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-7)
    if name == "stick":  # creeps by the softness of the friction, no more
        assert 1e-5 < np.abs(want[-1, 11:13]).max() < 0.02
    # The nominal model moves otherwise: the test can fail.
    nominal = mujoco_rollout(NOMINAL, SCENES[name], np.inf)
    assert np.abs(nominal - want).max() > 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_every_quantity_moves_the_rollout(simulator: Any, name: str) -> None:
    moved = simulator.rollouts[1 + NAMES.index(name)] - simulator.rollouts[0]
    assert np.abs(moved).max() > 1e-5


def test_untouched_leaves_pass_through() -> None:
    """Under vmap only what varies gets a batch axis."""
    m = mujoco.MjModel.from_xml_string(xml(NOMINAL))
    model = put_model(m, [["joint.cart.damping"], ["actuator.cart.kp"]])
    got = with_parameters(model, jnp.array([0.3, 30.0]))
    old, new = (jax.tree.leaves_with_path(x) for x in (model, got))
    changed = {
        jax.tree_util.keystr(path)
        for (path, a), (_, b) in zip(old, new, strict=True)
        if a is not b
    }
    fields = ("dof_damping", "actuator_gainprm", "actuator_biasprm")
    assert changed == {f".mjx.{f}" for f in fields}
    assert put_model(m).writers == ()


def test_no_lapack_for_small_machines() -> None:
    """A batched LAPACK call can deadlock on few cores, and is slow."""
    m = mujoco.MjModel.from_xml_string(xml(NOMINAL))
    model = put_model(m, [["body.pole.mass"]])
    text = str(jax.make_jaxpr(with_parameters)(model, jnp.ones(1)))
    for name in ("cholesky", "triangular_solve", " lu[", "custom_linear_solve"):
        assert name not in text


def test_forward_derivatives_of_constants() -> None:
    """`refine` and the information matrix differentiate through the writing."""
    m = mujoco.MjModel.from_xml_string(xml(NOMINAL))
    with jax.enable_x64(True):
        model = put_model(m, [["body.pole.mass"], ["geom.pole.length"]])

        @jax.jit
        def weights(theta: jax.Array) -> jax.Array:
            return with_parameters(model, theta).mjx.dof_invweight0[:2]

        at, step = jnp.array([0.1, 0.3]), 1e-6
        got = np.asarray(jax.jacfwd(weights)(at))
        for i in range(2):
            e = step * jnp.eye(2)[i]
            want = np.asarray(weights(at + e) - weights(at - e)) / (2 * step)
            np.testing.assert_allclose(got[:, i], want, rtol=1e-5, atol=1e-6)
            assert np.abs(want).max() > 0


# type, axis of its length, size, longer size, length, mass before and after
SHAPES: tuple[tuple[Any, ...], ...] = (
    ("capsule", 2, (0.05, 0.2), (0.05, 0.35), 0.8, 1.5, 0.7),
    ("cylinder", 2, (0.05, 0.2), (0.05, 0.4), 0.8, 1.5, 2.0),
    ("cylinder", 2, (0.05, 0.04), (0.05, 0.4), 0.8, 1.0, 1.3),
    ("box", 0, (0.2, 0.05, 0.1), (0.4, 0.05, 0.1), 0.8, 1.0, 1.0),
    ("box", 1, (0.05, 0.2, 0.1), (0.05, 0.1, 0.1), 0.2, 1.0, 3.0),
)
PLACE = np.array([0.05, 0.02, 0.2])


def shapes(places: Any, sizes: Any, masses: Any) -> mujoco.MjModel:
    """A body of each shape, hinged, its geom turned, with a child."""

    def text(x: Any) -> str:
        return " ".join(f"{float(y):.17g}" for y in x)

    bodies = "".join(
        f"""<body name="b{i}" pos="{i} 0 1"><joint/><geom name="g{i}" type="{row[0]}"
        mass="{mass}" pos="{text(place)}" euler="20 -40 60" size="{text(size)}"/>
        <body pos="0.1 0 0"><joint axis="1 0 0"/><geom size="0.03"
        contype="0" conaffinity="0"/></body></body>"""
        for i, (row, place, size, mass) in enumerate(
            zip(SHAPES, places, sizes, masses, strict=True)
        )
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><default><geom contype="0" conaffinity="0"/></default>
        <worldbody>{bodies}</worldbody></mujoco>"""
    )


@pytest.mark.parametrize("order", [1, pytest.param(-1, marks=pytest.mark.slow)])
def test_length_and_mass(order: int) -> None:
    """Of every solid, in either order, as the compiler has it."""
    kinds, axes, sizes, longer, lengths, masses, heavier = zip(*SHAPES, strict=True)
    before = shapes([PLACE] * len(kinds), sizes, masses)
    places = []
    for i, (kind, axis) in enumerate(zip(kinds, axes, strict=True)):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, before.geom(f"g{i}").quat)
        along = turn.reshape(3, 3)[:, axis]
        half = sum(sizes[i]) if kind == "capsule" else max(sizes[i])
        half = sizes[i][1] if kind == "cylinder" else half
        places.append(PLACE + (lengths[i] / (2 * half) - 1) * (PLACE @ along) * along)
    after = shapes(places, longer, heavier)
    n = len(kinds)
    addresses = [[f"geom.g{i}.length"] for i in range(n)]
    addresses += [[f"body.b{i}.mass"] for i in range(n)]
    theta = np.array([*lengths, *heavier])
    with jax.enable_x64(True):
        model = put_model(before, addresses[::order])
        got = jax.jit(with_parameters)(model, jnp.asarray(theta[::order])).mjx
        got = {f: np.asarray(getattr(got, f)) for f in LENGTH_FIELDS}
    for f, value in got.items():
        want = getattr(after, f)
        np.testing.assert_allclose(value, want, rtol=1e-9, atol=1e-12, err_msg=f)
        assert not np.allclose(want, getattr(before, f))


LENGTH_FIELDS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "geom_size",
    "geom_pos",
    "geom_rbound",
    "geom_aabb",
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('joint="cart" kp', 'delay="0.01" nsample="5" joint="cart" kp', "delay"),
        ('integrator="Euler"', 'integrator="implicit"', "mjINT_IMPLICIT.*implicitfast"),
        ('iterations="60"', 'iterations="60" solver="PGS"', "mjSOL_PGS.*Newton"),
        ('<joint name="pole"', '<joint name="pole" damping="1 2"', "polynomial"),
        ('timestep="0.002"', 'timestep="0.002" noslip_iterations="3"', "noslip"),
        ('<velocity name="wheel"', '<velocity name="wheel" armature="1"', "armature"),
        ('type="plane"', 'type="plane" adhesion="2"', "adhesion of geoms"),
        ('timestep="0.002"', 'timestep="0.002" actuatorgroupdisable="1"', "groupdis"),
        ('<joint name="pole"', '<joint name="pole" springyield="1"', "springyield"),
        ('dyntype="filterexact"', 'dyntype="filterexact" actearly="true"', "actearly"),
        (
            "<velocity",
            '<dcmotor joint="cart" motorconst="0.1" resistance="1"/><velocity',
            "DCMOTOR.*<motor>",
        ),
        ("<velocity", '<adhesion body="pole" ctrlrange="0 1"/><velocity', "joint="),
        (
            "</mujoco>",
            "<sensor><e_kinetic/></sensor></mujoco>",
            "mjSENS_E_KINETIC.*take these sensors out",
        ),
    ],
)
def test_refuses_what_mjx_lacks(old: str, new: str, message: str) -> None:
    text = xml(NOMINAL)
    assert old in text
    m = mujoco.MjModel.from_xml_string(text.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as error:
        put_model(m)
    assert "\n" not in str(error.value)
    assert str(error.value).endswith("in the model file")
