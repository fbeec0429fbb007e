"""Which parts of a machine nothing couples."""

import mujoco
import numpy as np
import pytest

from easi_jax.model.separate_trees import separate_trees, start_parts

_ARM = """<body name="{n}" pos="0 {y} 1"><joint name="{n}1" axis="1 0 0"/>
<geom size="0.05" mass="1"/><body pos="0 0 -0.3"><joint name="{n}2" axis="0 1 0"/>
<geom name="{n}" size="0.05" mass="1" contype="{t}" conaffinity="{t}"/></body></body>"""


def arms(touch: int = 0, base: str = "", more: str = "", drives: str = "") -> str:
    """Three arms of two joints; two of them ``touch``."""
    left = _ARM.format(n="a", y=0, t=touch)
    right = _ARM.format(n="b", y=0.2, t=touch)
    apart = _ARM.format(n="c", y=5, t=0)
    bodies = f"<body>{base}{left}{right}{apart}</body>"
    return f"""<mujoco><default><geom contype="0" conaffinity="0"/></default>
<worldbody><geom name="floor" type="plane" size="9 9 1" contype="1" conaffinity="1"/>
{bodies}</worldbody>{more}<actuator>{drives}</actuator></mujoco>"""


def parts(xml: str) -> list[int]:
    return separate_trees(mujoco.MjModel.from_xml_string(xml)).tolist()


def test_arms_in_a_stand_are_apart() -> None:
    assert parts(arms()) == [0, 0, 1, 1, 2, 2]


def test_arms_that_may_touch_are_one() -> None:
    """Touching the floor does not join them."""
    assert parts(arms(touch=1)) == [0, 0, 0, 0, 1, 1]


@pytest.mark.parametrize(
    "joined",
    [
        {"base": '<freejoint/><geom size="0.1" mass="3"/>'},
        {"more": '<equality><joint joint1="a1" joint2="b1"/></equality>'},
        {
            "more": '<tendon><fixed name="t"><joint joint="a1" coef="1"/>'
            '<joint joint="b1" coef="1"/></fixed></tendon>'
        },
        {"drives": '<adhesion body="a" ctrlrange="0 1"/>'},
    ],
)
def test_what_is_coupled_is_one(joined: dict[str, str]) -> None:
    more = (joined.get(key, "") for key in ("base", "more", "drives"))
    assert not any(parts(arms(0, *more)))


def test_activations_belong_to_their_joint() -> None:
    drives = "".join(
        f'<general joint="{j}" dyntype="filter" dynprm="0.1"/>' for j in ("b2", "a1")
    )
    m = mujoco.MjModel.from_xml_string(arms(drives=drives))
    dofs = [0, 0, 1, 1, 2, 2]
    np.testing.assert_array_equal(start_parts(m), [*dofs, *dofs, 1, 0])
