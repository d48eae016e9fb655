"""Which object is read, one lock for each device, joints without cameras."""

from __future__ import annotations

import gc
import math
import threading
from enum import Enum
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import RANGES, BlindDevice, RecordingDevice

from strands_robots.bus_access import (
    action_ranges,
    bus_lock,
    declared_numbers,
    joint_read_source,
    read_currents,
    read_joints,
    write_joints,
)
from strands_robots.hardware import DeviceBody


class Wrapper:
    def __init__(self, device: Any) -> None:
        self.device = device


class Slotted:
    __slots__ = ()

    def get_joints(self) -> dict[str, float]:
        return {"a": 1.0}


def test_a_wrapper_is_read_through_the_device_inside_it() -> None:
    device = RecordingDevice()
    assert joint_read_source(device) is device
    assert joint_read_source(Wrapper(device)) is device
    assert joint_read_source(Wrapper(Wrapper(device))) is device
    assert joint_read_source(Wrapper(None)) is None
    assert read_joints(Wrapper(None)) == {}


def test_a_native_driver_that_owns_its_bus_is_its_own_source() -> None:
    native = Slotted()
    assert joint_read_source(native) is native
    assert read_joints(native) == {"a": 1.0}
    assert bus_lock(native) is bus_lock(native)


def test_a_wrapper_and_its_device_share_one_reentrant_lock() -> None:
    device = RecordingDevice()
    lock = bus_lock(device)
    assert bus_lock(Wrapper(device)) is lock
    assert bus_lock(RecordingDevice()) is not lock
    with lock, lock:
        taken: list[bool] = []
        other = threading.Thread(target=lambda: taken.append(lock.acquire(blocking=False)))
        other.start()
        other.join()
    assert taken == [False]


def test_a_lock_goes_with_its_device() -> None:
    from strands_robots import bus_access  # noqa: PLC0415 - the table under test

    devices = [RecordingDevice() for _ in range(50)]
    # Of the others in the table some may go meanwhile: devices of earlier tests, which wait to be collected.
    ours = {id(device) for device in devices}
    for device in devices:
        bus_lock(device)
    assert ours <= bus_access._locks.keys()
    del devices, device
    gc.collect()
    assert not ours & bus_access._locks.keys()


def test_joints_are_read_from_the_motors_alone_where_there_is_one_bus() -> None:
    assert read_joints(BlindDevice()) == {"pan.pos": 10.0, "lift.pos": 10.0, "grip.pos": 10.0}


def test_the_numbers_of_an_observation_are_the_joints_of_any_other_device() -> None:
    assert read_joints(RecordingDevice()) == {"pan.pos": 10.0, "lift.pos": 10.0, "grip.pos": 10.0}


class Mode(Enum):
    RANGE_M100_100 = 1
    RANGE_0_100 = 2
    DEGREES = 3


def test_lerobots_motor_modes_are_ranges() -> None:
    motors = {mode.name: SimpleNamespace(norm_mode=mode) for mode in Mode}
    features = {f"{name}.pos": float for name in motors}
    calibration = {"DEGREES": SimpleNamespace(range_min=1024, range_max=3071)}
    bus = SimpleNamespace(motors=motors, calibration=calibration, sync_read=lambda register: {})
    device = SimpleNamespace(bus=bus, action_features=features, observation_features=features)
    ranges = action_ranges(device)
    assert ranges["RANGE_M100_100.pos"] == (-100.0, 100.0)
    assert ranges["RANGE_0_100.pos"] == (0.0, 100.0)
    low, high = ranges["DEGREES.pos"]
    assert high == -low
    assert math.isclose(high, 2047 / 2 * 360 / 4095)


def test_unknown_ranges_are_infinite_and_declared_ones_count() -> None:
    assert action_ranges(SimpleNamespace(action_features={"a": float})) == {"a": (-math.inf, math.inf)}
    assert action_ranges(RecordingDevice()) == dict(RANGES)


def test_motors_of_an_arm_have_their_ranges_beside_the_wheels_of_a_base() -> None:
    motors = {"arm_pan": SimpleNamespace(norm_mode=Mode.RANGE_M100_100), "left_wheel": SimpleNamespace(norm_mode=None)}
    bus = SimpleNamespace(motors=motors, calibration={}, sync_read=lambda register: {})
    actions = {"arm_pan.pos": float, "x.vel": float, "mode": str}
    device = SimpleNamespace(bus=bus, action_features=actions, observation_features=actions)
    assert action_ranges(device) == {"arm_pan.pos": (-100.0, 100.0), "x.vel": (-math.inf, math.inf)}


def test_numbers_that_a_device_does_not_declare_are_no_joints() -> None:
    observation = {"pan.pos": 1.0, "pan.target": 90.0, "note": "ok"}
    assert declared_numbers(SimpleNamespace(observation_features={"pan.pos": float}), observation) == {"pan.pos": 1.0}
    assert declared_numbers(SimpleNamespace(), observation) == {"pan.pos": 1.0, "pan.target": 90.0}


class Pair:
    """Two arms in one device, as LeRobot pairs them, with a camera that gives an error."""

    def __init__(self) -> None:
        self.left_arm, self.right_arm = BlindDevice(), BlindDevice()
        self.cameras = {"front": object()}

    @property
    def observation_features(self) -> dict[str, Any]:
        joints = self.left_arm.positions
        return {f"{side}_{key}": float for side in ("left", "right") for key in joints} | {"front": (480, 640, 3)}

    def get_observation(self) -> dict[str, Any]:
        raise TimeoutError("camera front gave no frame in 200 ms")


def test_a_pair_of_arms_is_read_without_its_failing_camera() -> None:
    pair = Pair()
    pair.right_arm.positions["pan.pos"] = 20.0
    joints = read_joints(pair)
    assert joints.keys() == {f"{side}_{name}.pos" for side in ("left", "right") for name in ("pan", "lift", "grip")}
    assert (joints["left_pan.pos"], joints["right_pan.pos"]) == (10.0, 20.0)


def test_several_buses_of_one_device_are_each_read() -> None:
    def bus(**positions: float) -> Any:
        return SimpleNamespace(motors=dict.fromkeys(positions), sync_read=lambda register: positions)

    features = {"pan.pos": float, "wheel.pos": float, "front": (4, 4, 3)}
    device = SimpleNamespace(arm=bus(pan=1), wheels=bus(wheel=2), observation_features=features, get_observation=None)
    device.get_observation = lambda: {"pan.pos": 5.0, "wheel.pos": 5.0, "speed": 7.0}
    assert read_joints(device) == {"pan.pos": 1.0, "wheel.pos": 2.0}
    device.observation_features = {**features, "speed": float}
    assert read_joints(device) == {"pan.pos": 5.0, "wheel.pos": 5.0, "speed": 7.0}, "the buses do not know the speed"


def test_each_bus_that_has_a_target_is_written_to_also_after_one_that_fails() -> None:
    written: list[dict[str, float]] = []

    def failing(register: str, goals: dict[str, float]) -> None:
        raise ConnectionError(f"no port for {goals}")

    def taking(register: str, goals: dict[str, float]) -> None:
        written.append(goals)

    pair = Pair()
    pair.left_arm.bus.sync_write, pair.right_arm.bus.sync_write = failing, taking
    with pytest.raises(ConnectionError, match="no port"):
        write_joints(pair, {"left_pan.pos": 1.0, "right_pan.pos": 2.0})
    write_joints(pair, {"right_pan.pos": 3.0})
    assert written == [{"pan": 2.0}, {"pan": 3.0}], "a bus without a target is not written to"


def test_pair_of_which_one_arm_is_limp_freezes_the_other() -> None:
    class Paired(Pair):
        name, is_connected = "pair", True

        def __init__(self) -> None:
            super().__init__()
            self.written: list[dict[str, float]] = []
            for arm in (self.left_arm, self.right_arm):
                arm.bus.disable_torque = lambda motor: None
                arm.bus.sync_write = self._write

        def _write(self, register: str, goals: dict[str, float]) -> None:
            next(iter(goals))  # as LeRobot does, which an empty one fails
            self.written.append(goals)

        @property
        def action_features(self) -> dict[str, Any]:
            return {key: kind for key, kind in self.observation_features.items() if kind is float}

        def connect(self) -> None: ...

        def disconnect(self) -> None: ...

        def send_action(self, action: dict[str, float]) -> dict[str, float]:
            for side in ("left_", "right_"):
                goals = {key.removeprefix(side): goal for key, goal in action.items() if key.startswith(side)}
                self._write("Goal_Position", goals)
            return action

    pair = Paired()
    body = DeviceBody("pair", pair)
    body.release(["left_pan", "left_lift", "left_grip"])
    assert pair.written == [{"pan": 10.0, "lift": 10.0, "grip": 10.0}]


def current_bus(model: str, **raw: int) -> Any:
    reads: list[tuple[str, list[str]]] = []

    def sync_read(register: str, motors: list[str]) -> dict[str, int]:
        reads.append((register, motors))
        return {name: raw[name] for name in motors}

    return SimpleNamespace(
        motors={name: SimpleNamespace(model=model) for name in raw}, sync_read=sync_read, reads=reads
    )


def test_currents_of_feetech_motors_are_read_in_ampere_whatever_their_direction() -> None:
    bus = current_bus("sts3215", pan=100, lift=100 | 1 << 15, grip=-100)
    features = {f"{name}.pos": float for name in bus.motors}
    device = SimpleNamespace(bus=bus, observation_features=features, get_observation=dict)
    assert read_currents(device) == pytest.approx(dict.fromkeys(features, 0.65))
    assert bus.reads == [("Present_Current", ["pan", "lift", "grip"])]


def test_currents_of_a_pair_are_called_as_its_joints_are() -> None:
    left, right = (SimpleNamespace(bus=current_bus("sts3215", pan=raw)) for raw in (100, 200))
    features = {"left_pan.pos": float, "right_pan.pos": float}
    pair = SimpleNamespace(left_arm=left, right_arm=right, observation_features=features, get_observation=dict)
    assert read_currents(pair) == pytest.approx({"left_pan.pos": 0.65, "right_pan.pos": 1.3})


def test_motors_of_an_unknown_unit_are_not_asked_for_their_current() -> None:
    bus = current_bus("xl330-m288", pan=100)
    device = SimpleNamespace(bus=bus, observation_features={"pan.pos": float}, get_observation=dict)
    assert read_currents(device) == {}
    assert bus.reads == []
    assert read_currents(BlindDevice()) == read_currents(RecordingDevice()) == read_currents(object()) == {}


def test_device_that_tells_its_currents_is_asked_for_them() -> None:
    device = RecordingDevice()
    device.get_currents = lambda: {"pan.pos": -0.5, "lift.pos": math.nan, "note": "warm"}  # type: ignore[attr-defined]
    assert read_currents(device) == {"pan.pos": 0.5}
