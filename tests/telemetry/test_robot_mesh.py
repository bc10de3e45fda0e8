"""A robot's body in the picture: from its URDF, with its joints, and without what is broken."""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import rerun as rr

from telemetry.dashboard import draw, headless_viewer, save_recording
from telemetry.picture import Picture, Scene, UrdfView
from tests.telemetry.boards import (
    MS,
    PASSAGES_NS,
    Chain,
    driverless,
    picture_of,
    pixels,
    read,
    read_static,
    retried,
)
from tests.telemetry.test_dashboard_viewer import complaints

FloatArray = npt.NDArray[np.float64]

LINK_M = 0.38
MESH = '<mesh filename="link.stl"/>'
BOX = f'<box size="{LINK_M} 0.05 0.05"/>'
SPHERE = '<sphere radius="0.06"/>'
CYLINDER = '<cylinder radius="0.03" length="0.2"/>'


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def write_stl(path: Path) -> None:
    """A tetrahedron as long as a link."""
    corners = np.array([[0, 0, 0], [LINK_M, 0, 0], [0, 0.08, 0], [0, 0, 0.08]], float)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = (struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    path.write_bytes(b" " * 80 + struct.pack("<I", len(faces)) + b"".join(triangles))


def urdf(folder: Path, joints: int, shapes: list[str]) -> UrdfView:
    """A planar arm of equal links, as the run's; a shape a link, and one fixed tool."""
    links, hinges = ['<link name="base"/>'], []
    for i in range(joints):
        visual = f"<visual><geometry>{shapes[i]}</geometry></visual>" if shapes[i] else ""
        hidden = f"<collision><geometry>{BOX}</geometry></collision>"
        links.append(f'<link name="link {i}">{visual}{hidden}</link>')
        hinges.append(
            f'<joint name="hinge {i}" type="revolute">'
            f'<parent link="{"base" if i == 0 else f"link {i - 1}"}"/><child link="link {i}"/>'
            f'<origin xyz="{LINK_M if i else 0} 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint>'
        )
    links.append(f'<link name="tool"><visual><geometry>{SPHERE}</geometry></visual></link>')
    hinges.append(
        f'<joint name="mount" type="fixed"><parent link="link {joints - 1}"/>'
        f'<child link="tool"/><origin xyz="{LINK_M} 0 0"/></joint>'
    )
    path = folder / f"arm_{joints}.urdf"
    path.write_text(f'<robot name="arm">{"".join(links + hinges)}</robot>')
    return UrdfView(path, tuple(f"hinge {i}" for i in range(joints)))


def bodied(folder: Path, chain: Chain, shape: str = MESH) -> Picture:
    write_stl(folder / "link.stl")
    arms = urdf(folder, 2, [shape, BOX]), urdf(folder, 3, [CYLINDER, SPHERE, ""])
    return picture_of(chain, 3, Scene(), arms)


def placed(names: tuple[str, ...], components: dict[str, list[Any]]) -> dict[str, FloatArray]:
    """Translation and quaternion (r, 7) by child frame."""
    children = [frame for [frame] in components["Transform3D:child_frame"]]
    rows = np.column_stack(
        [
            np.array([value for [value] in components[f"Transform3D:{part}"]])
            for part in ("translation", "quaternion")
        ]
    )
    return {name: rows[[child == name for child in children]] for name in names}


def test_the_body_is_static_and_its_joints_move_with_the_rows(
    spatial_run: Any, chain: Chain, tmp_path: Path
) -> None:
    path = tmp_path / "run.rrd"
    save_recording(path, bodied(tmp_path, chain), spatial_run.batches(PASSAGES_NS)[:80])
    static = read_static(path)
    root = "/mesh_local/arm/visual_geometries"
    shapes = {
        f"{root}/link\\ 0/visual_0": {"Asset3D:blob", "Asset3D:albedo_factor"},
        f"{root}/link\\ 1/visual_0": {"Boxes3D:half_sizes", "Boxes3D:colors"},
        f"{root}/tool/visual_0": {"Ellipsoids3D:half_sizes", "Ellipsoids3D:colors"},
        "/mesh_remote/arm/visual_geometries/link\\ 0/visual_0": {"Cylinders3D:colors"},
    }
    for entity, components in shapes.items():
        assert components <= static[entity], entity
    assert not [entity for entity in static if "collision" in entity]
    recorded = read(path)
    for name, rows, joints in (("local", spatial_run.local, 2), ("remote", spatial_run.remote, 3)):
        times_ns, components = recorded[f"/mesh_{name}/joints"]
        assert np.array_equal(np.unique(times_ns), recorded[f"/scene/{name}/arm"][0])
        frames = tuple(f"{name}/link {i}" for i in range(joints))
        for joint, (_, poses) in enumerate(placed(frames, components).items()):
            angles = rows["q"][np.unique(times_ns) // MS, joint]
            # a turn about z, beyond the limits of the file too
            expected = np.column_stack(
                [np.zeros((len(angles), 2)), np.sin(angles / 2), np.cos(angles / 2)]
            )
            same = np.abs(np.sum(poses[:, 3:] * expected, axis=1))
            assert same == pytest.approx(1.0, abs=1e-6)
            assert poses[:, 0] == pytest.approx(LINK_M if joint else 0.0)


def warnings_of(path: Path) -> list[str]:
    _, components = read(path)["/events"]
    levels = [level for [level] in components["TextLog:level"]]
    texts = [text for [text] in components["TextLog:text"]]
    return [t for t, level in zip(texts, levels, strict=True) if level == "WARN" and "drawn" in t]


@pytest.mark.parametrize(
    "shape", ['<mesh filename="none.stl"/>', '<mesh filename="package://nowhere/none.dae"/>']
)
def test_a_mesh_that_is_missing_is_named_and_the_rest_is_drawn(
    spatial_run: Any, chain: Chain, tmp_path: Path, shape: str
) -> None:
    path = tmp_path / "run.rrd"
    save_recording(path, bodied(tmp_path, chain, shape), spatial_run.batches(PASSAGES_NS)[:40])
    [told] = warnings_of(path)
    assert "local robot is drawn without the mesh of link 0" in told
    recorded = read(path)
    assert "/mesh_local/joints" in recorded
    assert len(recorded["/scene/local/arm"][0]) > 20  # its lines


def test_a_file_that_is_no_urdf_leaves_the_lines(
    spatial_run: Any, chain: Chain, tmp_path: Path
) -> None:
    picture = bodied(tmp_path, chain)
    (tmp_path / "arm_2.urdf").write_text("<robot name='arm'><link")
    path = tmp_path / "run.rrd"
    save_recording(path, picture, spatial_run.batches(PASSAGES_NS)[:40])
    [told] = warnings_of(path)
    assert "local robot is drawn as lines, arm_2.urdf" in told
    recorded = read(path)
    assert "/mesh_local/joints" not in recorded
    assert "/mesh_remote/joints" in recorded
    assert len(recorded["/scene/local/arm"][0]) > 20


def orange(image: npt.NDArray[np.int16]) -> int:
    """How much of a picture is of the local site's hue, lit or in shade."""
    red, green, blue = np.moveaxis(image, 2, 0)
    return int(((red > 80) & (green > 0.55 * red) & (green < 0.8 * red) & (blue < 0.4 * red)).sum())


@driverless
@pytest.mark.viewer
def test_the_viewer_shows_bodies_and_does_without_broken_ones(
    spatial_run: Any, chain: Chain, tmp_path: Path
) -> None:
    arrivals = spatial_run.batches(PASSAGES_NS)[:60]
    broken = tmp_path / "broken"
    broken.mkdir()
    pictures = {"bare": picture_of(chain, 3, Scene()), "whole": bodied(tmp_path, chain)}
    pictures["broken"] = bodied(broken, chain)
    (broken / "link.stl").write_bytes(os.urandom(200))
    seen = {}

    def attempt() -> None:
        for kind, picture in pictures.items():
            with headless_viewer(1280, 720) as client:
                draw(client, picture, arrivals)
                [view] = [v for v in client.get_state().views if v.name.startswith("Local")]
                seen[kind] = orange(pixels(client.take_screenshot(view.view_id)))
                if kind == "whole":
                    assert complaints(client) == []

    retried(attempt)
    assert seen["whole"] > 1.5 * seen["bare"]
    assert seen["broken"] > 300
