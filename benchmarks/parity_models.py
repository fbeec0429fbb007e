"""MuJoCo's features, each as a small model: what `benchmarks.parity` goes through."""

from collections.abc import Iterator

_ARM = """
<body name="upper">
  <joint name="shoulder" axis="0 1 0" {joint}/>
  <geom name="g1" type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4" {geom}/>
  <site name="s1" pos="0 0.05 -0.2"/>
  <body name="lower" pos="0 0 -0.4">
    <joint name="elbow" axis="0 1 0"/>
    <geom name="g2" type="capsule" size="0.03" fromto="0 0 0 0 0.1 -0.4"/>
    <site name="s2" pos="0 0.1 -0.4"/>
  </body>
</body>
<site name="s0" pos="0.2 0 0.1"/>
"""

# Bodies that collide: the shape, and the height at which it rests.
_SHAPES = {
    "sphere": ('type="sphere" size="0.1"', 0.1),
    "capsule": ('type="capsule" size="0.05 0.1"', 0.1),
    "cylinder": ('type="cylinder" size="0.08 0.1"', 0.1),
    "ellipsoid": ('type="ellipsoid" size="0.1 0.08 0.06"', 0.08),
    "box": ('type="box" size="0.1 0.08 0.06"', 0.08),
    "mesh": ('type="mesh" mesh="solid"', 0.08),
}
_ASSET = """
<asset>
  <mesh name="solid" vertex="0.1 0 0  -0.1 0 0  0 0.1 0  0 -0.1 0  0 0 0.1  0 0 -0.1"/>
  <hfield name="ground" nrow="3" ncol="3" size="1 1 0.1 0.1"
    elevation="0 0.2 0  0.3 0.5 0.1  0 0.4 0"/>
</asset>
"""


def _model(world: str, rest: str = "", option: str = "", flags: str = "") -> str:
    flag = f"<flag {flags}/>" if flags else ""
    return (
        f'<mujoco><option timestep="0.002" {option}>{flag}</option>'
        f"<worldbody>{world}</worldbody>{rest}</mujoco>"
    )


def _arm(
    rest: str = "", option: str = "", flags: str = "", joint: str = "", geom: str = ""
) -> str:
    return _model(_ARM.format(joint=joint, geom=geom), rest, option, flags)


def _on_floor(
    shape: str,
    geom: str = "",
    option: str = "",
    floor: str = 'type="plane" size="2 2 1"',
    flags: str = "",
    rest: str = "",
) -> str:
    text, height = _SHAPES[shape]
    world = (
        f'<geom {floor}/><body name="b" pos="0 0 {height + 0.03}"><freejoint name="f"/>'
        f"<geom {text} {geom}/></body>"
    )
    return _model(world, _ASSET + rest, option, flags)


def _pair(one: str, two: str) -> str:
    """Two bodies on slides that press one on the other, tilted, with free turns."""
    a, b = (_SHAPES[k][0] for k in (one, two))
    world = (
        f'<body quat="1 0.2 0.1 0"><joint type="ball" name="t" damping="0.1"/>'
        f'<geom {a} mass="5"/></body>'
        f'<body pos="0.01 0.02 0.2"><freejoint name="f"/><geom {b}/></body>'
    )
    return _model(world, _ASSET)


def _actuated(text: str, **kwargs: str) -> str:
    return _arm(f"<actuator>{text}</actuator>", **kwargs)


def _joints() -> Iterator[tuple[str, str]]:
    mass = '<geom type="box" size="0.1 0.05 0.02" pos="0.05 0 0.02"/>'
    for kind in ("hinge", "slide", "ball", "free"):
        joint = f'<joint name="j" type="{kind}"/>'
        yield f"joint {kind}", _model(f"<body>{joint}{mass}</body>")
    for name, words in {
        "armature": 'armature="0.1"',
        "damping": 'damping="0.3"',
        "stiffness": 'stiffness="4" springref="0.3"',
        "frictionloss": 'frictionloss="0.2"',
        "range": 'range="-20 20"',
        "springdamper": 'springdamper="0.2 0.7"',
        "polynomial stiffness": 'stiffness="4 2 1"',
        "polynomial damping": 'damping="0.3 0.2 0.1"',
        "actuator force range": 'actuatorfrcrange="-0.3 0.3"',
        "spring yield": 'stiffness="4" springyield="0.2"',
    }.items():
        act = '<actuator><motor joint="shoulder"/></actuator>'
        yield f"joint {name}", _arm(act, joint=words)
    limit = '<joint name="j" type="ball" range="0 20" stiffness="2" damping="0.1"/>'
    yield "ball limit", _model(f"<body>{limit}{mass}</body>")


def _actuators() -> Iterator[tuple[str, str]]:
    at = 'name="a" joint="elbow"'
    for name, text in {
        "motor": f'<motor {at} gear="2"/>',
        "motor limits": f'<motor {at} ctrlrange="-0.4 0.4" forcerange="-0.3 0.3"/>',
        "position": f'<position {at} kp="5" kv="0.5"/>',
        "position timeconst": f'<position {at} kp="5" timeconst="0.05"/>',
        "position dampratio": f'<position {at} kp="5" dampratio="0.7"/>',
        "velocity": f'<velocity {at} kv="2"/>',
        "intvelocity": f'<intvelocity {at} kp="5" actrange="-1 1"/>',
        "damper": f'<damper {at} kv="2" ctrlrange="0 1"/>',
        "cylinder": f'<cylinder {at} timeconst="0.1" area="0.02" bias="0 -1 -0.1"/>',
        "muscle": f'<muscle {at} ctrlrange="0 1" lengthrange="-2 2"/>',
        "dcmotor": f'<dcmotor {at} motorconst="0.1 0.1" resistance="1"/>',
        "pid": f'<pid {at} kp="5" ki="1" kv="0.1"/>',
        "damping": f'<motor {at} damping="0.3"/>',
        "armature": f'<motor {at} armature="0.1"/>',
        "delay": f'<motor {at} delay="0.01" nsample="6"/>',
        "actearly": f'<general {at} dyntype="filter" dynprm="0.05" actearly="true"/>',
        "group disabled": '<motor joint="elbow" group="1"/>',
        "plugin": "",
    }.items():
        if name == "plugin":
            yield (
                "actuator plugin",
                _arm(
                    '<extension><plugin plugin="mujoco.pid"/></extension><actuator>'
                    '<plugin plugin="mujoco.pid" joint="elbow"/></actuator>'
                ),
            )
            continue
        option = 'actuatorgroupdisable="1"' if name == "group disabled" else ""
        yield f"actuator {name}", _actuated(text, option=option)
    for kind in ("none", "integrator", "filter", "filterexact", "muscle"):
        words = f'dyntype="{kind}"'
        if kind != "none":
            words += ' dynprm="0.05 0.04 0"'
        yield f"dynamics {kind}", _actuated(f"<general {at} {words}/>")
    for kind, prm in (("fixed", "3"), ("affine", "3 0.5 0.2")):
        text = f'<general {at} gaintype="{kind}" gainprm="{prm}"/>'
        yield f"gain {kind}", _actuated(text)
    yield (
        "bias affine",
        _actuated(f'<general {at} biastype="affine" biasprm="0.1 -3 -0.2"/>'),
    )
    for integrator in ("implicitfast", "implicit"):
        for name, text in {
            "position": f'<position {at} kp="50" kv="5" forcerange="-3 3"/>',
            "damper": f'<damper {at} kv="2" ctrlrange="0 1"/>',
            "limited damper": f'<damper {at} kv="2" ctrlrange="0 1" '
            'forcerange="-0.2 0.2"/>',
            "muscle": f'<muscle {at} ctrlrange="0 1" lengthrange="-2 2"/>',
        }.items():
            option = f'integrator="{integrator}"'
            yield f"{integrator} with {name}", _actuated(text, option=option)


def _transmissions() -> Iterator[tuple[str, str]]:
    yield (
        "transmission jointinparent",
        _model(
            '<body><joint name="b" type="ball" damping="0.1"/>'
            '<geom type="box" size="0.1 0.05 0.02" pos="0.1 0 0"/></body>',
            '<actuator><motor jointinparent="b" gear="1 0.5 0.2"/></actuator>',
        ),
    )
    yield "transmission site", _actuated('<motor site="s2" gear="1 0.3 0.2 0 0.1 0"/>')
    yield (
        "transmission site refsite",
        _actuated('<position site="s2" refsite="s0" kp="5" gear="1 0 0.5 0 0 0"/>'),
    )
    yield (
        "transmission slidercrank",
        _actuated('<motor cranksite="s2" slidersite="s0" cranklength="2"/>'),
    )
    fixed = (
        '<tendon><fixed name="t"><joint joint="shoulder" coef="1"/>'
        '<joint joint="elbow" coef="-0.5"/></fixed></tendon>'
    )
    motor = '<actuator><motor tendon="t"/></actuator>'
    yield "transmission fixed tendon", _arm(fixed + motor)
    spatial = (
        '<tendon><spatial name="t"><site site="s0"/><site site="s2"/></spatial>'
        "</tendon>"
    )
    yield "transmission spatial tendon", _arm(spatial + motor)
    yield (
        "transmission body adhesion",
        _on_floor(
            "sphere",
            'margin="0.02"',
            rest='<actuator><adhesion body="b" gain="5" ctrlrange="0 1"/></actuator>',
        ),
    )
    yield (
        "transmission so3",
        _model(
            '<body><joint name="b" type="ball" damping="0.1"/>'
            '<geom type="box" size="0.1 0.05 0.02" pos="0.1 0 0"/></body>',
            '<actuator><orientation joint="b" kp="3"/></actuator>',
        ),
    )


def _equalities() -> Iterator[tuple[str, str]]:
    for name, text in {
        "connect body": '<connect body1="lower" anchor="0 0.1 -0.4"/>',
        "connect site": '<connect site1="s2" site2="s0"/>',
        "weld body": '<weld body1="lower"/>',
        "weld bodies": '<weld body1="lower" body2="upper"/>',
        "weld site": '<weld site1="s2" site2="s0"/>',
        "joint": '<joint joint1="shoulder" joint2="elbow" polycoef="0.1 1 0.2 0 0"/>',
        "joint alone": '<joint joint1="shoulder" polycoef="0.3"/>',
        "inactive": '<weld body1="lower" active="false"/>',
    }.items():
        yield f"equality {name}", _arm(f"<equality>{text}</equality>")
    tendons = (
        '<tendon><fixed name="t"><joint joint="shoulder" coef="1"/></fixed>'
        '<fixed name="u"><joint joint="elbow" coef="0.5"/></fixed></tendon>'
    )
    yield (
        "equality tendon",
        _arm(tendons + '<equality><tendon tendon1="t" tendon2="u"/></equality>'),
    )
    for name, solref in (("soft", "0.1 0.5"), ("direct", "-200 -20")):
        yield (
            f"equality {name}",
            _arm(
                f'<equality><connect body1="lower" anchor="0 0.1 -0.4" '
                f'solref="{solref}"/>'
                "</equality>"
            ),
        )


def _tendons() -> Iterator[tuple[str, str]]:
    sites = '<site site="s0"/>{wrap}<site site="s2"/>'
    for name, words in {
        "spring": 'stiffness="20" springlength="0.1"',
        "damping": 'damping="2"',
        "friction": 'frictionloss="0.5"',
        "limit": 'range="0.2 0.45"',
        "armature": 'armature="0.1"',
        "polynomial stiffness": 'stiffness="20 3" springlength="0.1"',
    }.items():
        body = sites.format(wrap="")
        yield (
            f"tendon {name}",
            _arm(f'<tendon><spatial name="t" {words}>{body}</spatial></tendon>'),
        )
    yield (
        "tendon fixed spring",
        _arm(
            '<tendon><fixed stiffness="5" damping="0.2">'
            '<joint joint="shoulder" coef="1"/>'
            '<joint joint="elbow" coef="0.7"/></fixed></tendon>'
        ),
    )
    yield (
        "tendon pulley",
        _arm(
            '<tendon><spatial stiffness="20"><site site="s0"/><site site="s1"/>'
            '<pulley divisor="2"/><site site="s0"/><site site="s2"/></spatial></tendon>'
        ),
    )
    for shape in ("sphere", "cylinder"):
        wrap = f'<geom name="w" type="{shape}" size="0.05 0.2" pos="0.1 0 -0.1"/>'
        wrap = wrap.replace("<geom", '<geom contype="0" conaffinity="0"')
        body = sites.format(wrap='<geom geom="w"/>')
        yield (
            f"tendon wraps {shape}",
            _model(
                wrap + _ARM.format(joint="", geom=""),
                f'<tendon><spatial stiffness="20">{body}</spatial></tendon>',
            ),
        )


def _contacts() -> Iterator[tuple[str, str]]:
    for shape in _SHAPES:
        yield f"contact plane {shape}", _on_floor(shape)
    ground = 'type="hfield" hfield="ground"'
    for shape in _SHAPES:
        yield f"contact hfield {shape}", _on_floor(shape, floor=ground)
    names = list(_SHAPES)
    for i, one in enumerate(names):
        for two in names[i:]:
            yield f"contact {one} {two}", _pair(one, two)
    for cone in ("pyramidal", "elliptic"):
        for dim in (1, 3, 4, 6):
            yield (
                f"cone {cone} condim {dim}",
                _on_floor(
                    "sphere",
                    f'condim="{dim}"',
                    f'cone="{cone}"',
                    'type="plane" size="2 2 1" condim="1"',
                ),
            )
    two = '<geom type="sphere" size="0.05" pos="0.12 0 0" condim="1"/>'
    yield (
        "cone elliptic, condim 1 and 3",
        _model(
            '<geom type="plane" size="2 2 1" condim="1"/>'
            '<body pos="0 0 0.1"><freejoint/>'
            f'<geom type="sphere" size="0.05" condim="3"/>{two}</body>',
            option='cone="elliptic"',
        ),
    )
    yield "contact margin", _on_floor("sphere", 'margin="0.05"')
    yield "contact gap", _on_floor("sphere", 'margin="0.05" gap="0.05"')
    yield "contact surface velocity", _on_floor("sphere", 'surfacevel="0 1 0.5 0 0 0"')
    yield "contact geom adhesion", _on_floor("sphere", 'adhesion="10"')
    yield (
        "contact impratio",
        _on_floor("sphere", option='cone="elliptic" impratio="10"'),
    )
    yield (
        "contact pair",
        _model(
            '<geom name="p" type="plane" size="2 2 1" contype="0"/>'
            '<body pos="0 0 0.1"><freejoint/>'
            '<geom name="s" size="0.1" contype="0"/></body>',
            '<contact><pair geom1="p" geom2="s" condim="4" '
            'friction="0.5 0.8 0.01 0 0"/></contact>',
        ),
    )
    yield (
        "contact override",
        _on_floor("sphere", option='o_solref="0.05 0.8"', flags='override="enable"'),
    )


def _options() -> Iterator[tuple[str, str]]:
    push = '<actuator><position joint="elbow" kp="5" kv="0.2"/></actuator>'
    joint = 'damping="0.3" stiffness="3" frictionloss="0.1" range="-20 20"'
    for kind in ("Euler", "RK4", "implicit", "implicitfast", "discrete"):
        option = f'integrator="{kind}"'
        yield f"integrator {kind}", _arm(push, option, joint=joint)
    for kind in ("PGS", "CG", "Newton"):
        yield f"solver {kind}", _on_floor("sphere", option=f'solver="{kind}"')
    yield "noslip", _on_floor("sphere", option='noslip_iterations="5"')
    for flag in (
        *("constraint", "equality", "frictionloss", "limit", "contact", "spring"),
        *("damper", "gravity", "clampctrl", "warmstart", "filterparent", "actuation"),
        *("refsafe", "sensor", "midphase", "eulerdamp", "autoreset", "nativeccd"),
        *("island", "multiccd"),
    ):
        world = '<geom type="plane" size="2 2 1" pos="0 0 -0.75"/>' + _ARM.format(
            joint=joint, geom=""
        )
        rest = push.replace("/></", ' ctrlrange="-0.2 0.2"/></') + (
            '<equality><joint joint1="elbow" polycoef="0.2"/></equality>'
            '<sensor><jointpos joint="elbow"/></sensor>'
        )
        yield f"flag {flag} disabled", _model(world, rest, flags=f'{flag}="disable"')
    for flag in ("energy", "fwdinv", "invdiscrete", "sleep", "ipc", "diagexact"):
        option = 'integrator="discrete"' if flag == "ipc" else ""
        on = f'{flag}="enable"'
        yield f"flag {flag} enabled", _on_floor("sphere", option=option, flags=on)


def _elements() -> Iterator[tuple[str, str]]:
    push = '<actuator><position joint="elbow" kp="5" kv="0.2"/></actuator>'
    yield "fluid box", _arm(option='density="200" viscosity="0.5" wind="1 0 0"')
    yield (
        "fluid box implicitfast",
        _arm(option='density="200" viscosity="0.5" integrator="implicitfast"'),
    )
    yield (
        "fluid ellipsoid",
        _arm(option='density="200" viscosity="0.5"', geom='fluidshape="ellipsoid"'),
    )
    yield (
        "gravcomp",
        _model(
            _ARM.format(joint="", geom="").replace(
                'name="lower"', 'name="l" gravcomp="0.7"'
            )
        ),
    )
    yield (
        "gravcomp by actuators",
        _model(
            _ARM.format(joint='actuatorgravcomp="true"', geom="").replace(
                'name="lower"', 'name="l" gravcomp="0.7"'
            ),
            push,
        ),
    )
    yield (
        "mocap",
        _model(
            '<body name="m" mocap="true" pos="0.1 0 -0.7"><geom size="0.02"/></body>'
            + _ARM.format(joint="", geom=""),
            '<equality><connect body1="lower" body2="m" anchor="0 0.1 -0.4"/>'
            "</equality>",
        ),
    )
    yield (
        "flex cable",
        _model(
            '<flexcomp name="c" type="grid" count="5 1 1" spacing="0.05 0.05 0.05"'
            ' dim="1" radius="0.01" mass="0.1"><edge equality="true"/></flexcomp>'
        ),
    )
    yield (
        "flex cloth",
        _model(
            '<geom type="plane" size="1 1 1" pos="0 0 -0.05"/>'
            '<flexcomp name="c" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" dim="2"'
            ' radius="0.01" mass="0.1"><elasticity young="1e3" poisson="0.2"/>'
            "</flexcomp>"
        ),
    )
    yield (
        "sensor delay",
        _arm('<sensor><jointpos joint="elbow" delay="0.01" nsample="6"/></sensor>'),
    )


def feature_models() -> dict[str, str]:
    """Every feature by name, and the MJCF text of a model that has it."""
    parts = (_joints, _actuators, _transmissions, _equalities, _tendons)
    parts = (*parts, _contacts, _options, _elements)
    return {n: t for part in parts for n, t in part()}
