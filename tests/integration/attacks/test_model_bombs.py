"""Models that ask for more than any robot has, refused by name before MuJoCo reads them."""

from __future__ import annotations

import os
import resource
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest

from strands_robots.kinematics import model_file
from strands_robots.simulation import scene
from strands_robots.utils import ValidationError

Bomb = Callable[[Path], str]
"""Writes what it needs beside the model, and returns the model's text."""


def world(text: str, before: str = "") -> str:
    return f"<mujoco>{before}<worldbody>{text}</worldbody></mujoco>"


def entities(folder: Path) -> str:
    lines = ['<!ENTITY a0 "aaaaaaaaaa">']
    lines += [f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 10)]
    return f"<!DOCTYPE mujoco [{''.join(lines)}]>" + world('<body name="&a9;"/>')


def a_million_bodies(folder: Path) -> str:
    return world('<body><geom size="1"/></body>' * 1_000_000)


def many_small_bodies(folder: Path) -> str:
    return world("<body/>" * 20_000)


def replicated_bodies(folder: Path) -> str:
    return world('<replicate count="100">' * 3 + "<body/>" + "</replicate>" * 3)


def replicated_geoms(folder: Path) -> str:
    return world('<replicate count="9000">' + '<geom size="1"/>' * 1000 + "</replicate>")


def composite(folder: Path) -> str:
    return world('<body><composite type="cable" count="1000000 1 1" size="1"/></body>')


def flexcomp(folder: Path) -> str:
    return world('<flexcomp name="f" type="grid" count="1000 1000 1000" spacing="1 1 1"/>')


def deep(folder: Path) -> str:
    return world("<body>" * 5_000 + "</body>" * 5_000)


def includes_itself(folder: Path) -> str:
    return '<mujoco><include file="model.xml"/></mujoco>'


def includes_many(folder: Path) -> str:
    folder.joinpath("part.xml").write_text("<mujoco/>")
    return "<mujoco>" + '<include file="part.xml"/>' * 1_000 + "</mujoco>"


def attaches_itself(folder: Path) -> str:
    asset = '<asset><model name="m" file="model.xml"/></asset>'
    return world('<body><attach model="m" prefix="a"/></body>', asset)


def attaches_many(folder: Path) -> str:
    folder.joinpath("part.xml").write_text(world("<body/>" * 1_000))
    asset = '<asset><model name="m" file="part.xml"/></asset>'
    return world('<replicate count="1000"><body><attach model="m" prefix="a"/></body></replicate>', asset)


def huge_mesh(folder: Path) -> str:
    with folder.joinpath("big.stl").open("wb") as file:
        file.truncate(8 * 2**30)  # sparse: it takes no space
    return world('<geom type="mesh" mesh="big"/>', '<asset><mesh name="big" file="big.stl"/></asset>')


def many_meshes(folder: Path) -> str:
    for number in range(10):
        with folder.joinpath(f"m{number}.stl").open("wb") as file:
            file.truncate(60 * 2**20)
    return world("", "<asset>" + "".join(f'<mesh file="m{number}.stl"/>' for number in range(10)) + "</asset>")


def endless_mesh(folder: Path) -> str:
    folder.joinpath("zero.stl").symlink_to("/dev/zero")
    return world("", '<asset><mesh name="z" file="zero.stl"/></asset>')


def mesh_that_is_a_pipe(folder: Path) -> str:
    os.mkfifo(folder / "pipe.obj")
    return world("", '<asset><mesh name="p" file="pipe.obj"/></asset>')


def picture_that_unpacks(folder: Path) -> str:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    packed = zlib.compressobj(9)
    rows = b"".join(packed.compress(b"\0" * 90_001) for _ in range(2_000)) + packed.flush()
    picture = chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    folder.joinpath("t.png").write_bytes(b"\x89PNG\r\n\x1a\n" + picture)
    return world("", '<asset><texture name="t" type="2d" file="t.png"/></asset>')


def made_picture(folder: Path) -> str:
    return world("", '<asset><texture name="t" builtin="flat" width="100000" height="100000"/></asset>')


def height_field(folder: Path) -> str:
    return world("", '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>')


def memory(folder: Path) -> str:
    return world("", '<size memory="64G"/>')


def numbers(folder: Path) -> str:
    return world("", '<custom><numeric name="n" size="2000000000"/></custom>')


def sensors(folder: Path) -> str:
    return world("", '<sensor><user name="s" dim="2000000000"/></sensor>')


BOMBS: list[tuple[Bomb, str]] = [
    (entities, "declares XML entities"),
    (a_million_bodies, "more than 16 MiB"),
    (many_small_bodies, "more than 10,000 bodies"),
    (replicated_bodies, "more than"),
    (replicated_geoms, "more than 200,000 elements"),
    (composite, "composite asks for 1,000,000 parts"),
    (flexcomp, "flexcomp asks for 1,000,000,000 parts"),
    (deep, "more than 200 deep"),
    (includes_itself, "includes itself"),
    (includes_many, "includes more than 256 files"),
    (attaches_itself, "includes itself"),
    (attaches_many, "attaches more than 10,000 bodies"),
    (huge_mesh, "big.stl has more than 64 MiB"),
    (many_meshes, "above 512 MiB"),
    (endless_mesh, "zero.stl is no regular file"),
    (mesh_that_is_a_pipe, "pipe.obj is no regular file"),
    (picture_that_unpacks, "t.png takes its pictures"),
    (made_picture, "texture t takes its pictures"),
    (height_field, "hfield h takes its pictures"),
    (memory, "MiB of memory"),
    (numbers, "size of numeric"),
    (sensors, "dim of user"),
]


@pytest.mark.parametrize(("bomb", "why"), BOMBS, ids=lambda each: getattr(each, "__name__", ""))
def test_bomb_is_refused_by_name_before_mujoco_reads_it(
    bomb: Bomb, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.xml"
    path.write_text(bomb(tmp_path))
    monkeypatch.setattr(mujoco.MjSpec, "from_file", lambda path: pytest.fail("MuJoCo read it"))
    before, began = resource.getrusage(resource.RUSAGE_SELF), time.process_time()
    with pytest.raises(ValidationError, match="model 'model' is refused: ") as refused:
        scene.find(path).load()
    assert why in str(refused.value)
    assert time.process_time() - began < 5.0
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before.ru_maxrss) / 1024
    assert grown_mb < 100


def test_models_that_come_with_the_package_are_within_the_bounds() -> None:
    for name in scene.BUILT_IN:
        assert scene.find(name).load().bodies


def test_model_with_meshes_pictures_and_parts_loads(tmp_path: Path) -> None:
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
    other = struct.pack("<12fH", 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1, 0, 0)
    (tmp_path / "parts").mkdir()
    mesh = b" " * 80 + struct.pack("<I", 4) + (triangle + other) * 2
    (tmp_path / "parts" / "hull.stl").write_bytes(mesh)
    (tmp_path / "more.xml").write_text(world('<body name="other"><geom size="1"/></body>'))
    asset = '<compiler meshdir="parts"/><asset><mesh name="hull" file="hull.stl"/></asset><include file="more.xml"/>'
    text = world('<replicate count="10" offset="0 0 1"><body><geom type="mesh" mesh="hull"/></body></replicate>', asset)
    (tmp_path / "model.xml").write_text(text)
    assert len(scene.find(tmp_path / "model.xml").load().bodies) == 12


@pytest.mark.parametrize("text", ["", "<mujoco", "no model", "<mujoco>\0</mujoco>"])
def test_file_that_is_no_model_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(text)
    with pytest.raises(ValidationError, match="model 'model' "):
        model_file.load_model(tmp_path / "model.xml", "model")
