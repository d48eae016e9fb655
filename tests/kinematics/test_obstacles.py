"""Objects in a chain's model: the contacts of a compiled model, without a compilation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

from strands_robots.kinematics.chain import CONTACT_BITS, MODELS, SPARES, Chain, Spares, built_in, held_body
from strands_robots.kinematics.objects import CLEARANCE_M, ContactCheck, Held, SeenObject, beside


def objects(count: int) -> list[SeenObject]:
    draw = np.random.default_rng(count)
    return [
        SeenObject(
            f"object {index}",
            np.array([*draw.uniform((0.1, -0.2), (0.3, 0.2)), 0.05]),
            float(draw.uniform(-3, 3)),
            draw.uniform(0.02, 0.1, 3),
            round=index % 2 == 0,
        )
        for index in range(count)
    ]


def compiled(seen: Sequence[SeenObject]) -> Any:
    """A model in which the objects are parts of the description."""
    spec = mujoco.MjSpec.from_file(str(MODELS / "so101.xml"))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.05])
    for each in seen:
        turned = [float(np.cos(each.yaw / 2)), 0.0, 0.0, float(np.sin(each.yaw / 2))]
        body = spec.worldbody.add_body(name=each.name, pos=list(each.position), quat=turned)
        x, y, z = (float(value) / 2 for value in each.size)
        kind, size = mujoco.mjtGeom.mjGEOM_BOX, [x + CLEARANCE_M, y + CLEARANCE_M, z]
        if each.round:
            kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [max(x, y) + CLEARANCE_M, z, 0.0]
        body.add_geom(type=kind, size=size, contype=CONTACT_BITS, conaffinity=CONTACT_BITS)
    return spec.compile()


@pytest.mark.parametrize("count", [1, 5, SPARES + 1])
def test_contacts_are_those_of_a_compiled_model(count: int) -> None:
    seen, chain = objects(count), built_in("so101")
    check, model = ContactCheck(beside(chain, seen)), compiled(seen)
    names = {each.name for each in seen}
    data, draw, touched = mujoco.MjData(model), np.random.default_rng(1), 0
    for _ in range(300):
        joints = draw.uniform(chain.lows, chain.highs)
        data.qpos[:] = chain.data(chain.rest).qpos
        data.qpos[[joint.qpos for joint in chain.joints]] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        deepest: dict[str, float] = {}
        for contact in data.contact[: data.ncon]:
            for geom in contact.geom:
                name = str(model.body(int(model.geom_bodyid[geom])).name)
                if name in names and contact.dist < 0:
                    deepest[name] = max(deepest.get(name, 0.0), -contact.dist)
        found: dict[str, float] = {}
        for pair, depth in check.at(joints).items():
            for name in set(pair) & names:
                found[name] = max(found.get(name, 0.0), depth)
        assert found == pytest.approx(deepest, abs=1e-9)
        touched += bool(found)
    assert touched > 5


def test_each_plan_has_objects_of_its_own_and_the_chain_has_none() -> None:
    chain = built_in("so101")
    first, second = (beside(chain, objects(count)) for count in (1, 2))
    assert (len(first.objects), len(second.objects), len(chain.objects)) == (1, 2, 0)
    assert first.model is not second.model


def test_held_object_goes_where_the_tip_goes() -> None:
    chain = built_in("so101")
    held = Held("cube", np.array([0.0, 0.0, 0.01]), 0.0125, 0.025, 90.0, 0.0125)
    crowded = beside(chain, [], held)
    draw = np.random.default_rng(2)
    for _ in range(20):
        joints = draw.uniform(chain.lows, chain.highs)
        at = crowded.data(joints).xpos[held_body(crowded.model)]
        assert at == pytest.approx(held.centre(chain.forward(joints)), abs=1e-9)


def test_planning_beside_objects_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    chain: Chain = built_in("so101")
    monkeypatch.setattr(Spares, "_grown", lambda *_: pytest.fail("a model was compiled"))
    beside(chain, objects(SPARES))
