"""Reader of furniture URDFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjhab.scenes.formats.urdf import read_urdf
from tests.refusals import refused

TEXT = """<robot name="box"><link name="root"/>
<link name="body"><inertial><mass value="3.5"/><inertia ixx="1.0"/></inertial>
<collision group="2"><origin rpy="0 0 1.5707963267948966" xyz="1, 2 3"/>
<geometry><box size="0.2 0.4, 0.6"/></geometry></collision>
<visual><geometry><mesh filename="body.glb" scale="1, 1, 1"/></geometry></visual></link>
<link name="lid"/>
<joint name="weld" type="fixed"><origin xyz="0 0 1"/><parent link="root"/><child link="body"/></joint>
<joint name="hinge" type="revolute"><origin xyz="0.5 0 0"/><parent link="body"/><child link="lid"/>
<axis xyz="0 0 2"/><limit lower="0" upper="1.5"/><dynamics damping="0.02" friction="0.3"/></joint></robot>"""


def read(tmp_path: Path, text: str):
    (tmp_path / "thing.urdf").write_text(text)
    return read_urdf(tmp_path / "thing.urdf")


def test_links_joints_and_number_lists_with_commas(tmp_path: Path) -> None:
    urdf = read(tmp_path, TEXT)
    (box,) = urdf.links["body"].boxes
    assert np.allclose(box.half, [0.1, 0.2, 0.3]) and np.allclose(
        box.pose[:3, 3], [1, 2, 3]
    )
    assert np.allclose(box.pose[:3, 0], [0, 1, 0], atol=1e-12)
    assert urdf.links["body"].mass == 3.5 and urdf.links["lid"].mass == 0.0
    assert (
        urdf.root == "root"
        and urdf.moving("body") == "root"
        and urdf.moving("lid") == "lid"
    )
    assert np.allclose(urdf.pose("lid")[:3, 3], [0.5, 0, 1])
    assert np.allclose(urdf.joints["lid"].axis, [0, 0, 1]) and urdf.joints[
        "lid"
    ].limits == (
        0.0,
        1.5,
    )
    assert urdf.links["body"].visuals[0].file == tmp_path / "body.glb"
    assert (urdf.joints["lid"].damping, urdf.joints["lid"].friction) == (0.02, 0.3)


def test_joints_without_dynamics_are_free_and_inertias_are_in_the_axes_of_the_link(
    tmp_path: Path,
) -> None:
    free = TEXT.replace('<dynamics damping="0.02" friction="0.3"/>', "")
    assert read(tmp_path, free).joints["lid"].damping == 0.0
    assert read(tmp_path, TEXT).links["body"].inertia is None  # it lacks iyy and izz
    whole = TEXT.replace(
        '<inertia ixx="1.0"/>',
        '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
        '<inertia ixx="1.0" iyy="2.0" izz="2.5" ixy="0" ixz="0" iyz="0"/>',
    )
    body = read(tmp_path, whole).links["body"]
    assert body.inertia is not None and np.allclose(body.com, [1, 2, 3])
    np.testing.assert_allclose(body.inertia, np.diag([2.0, 1.0, 2.5]), atol=1e-12)
    no_body = whole.replace('izz="2.5"', 'izz="4.0"')
    with refused(where="thing.urdf", said="link 'body': no body has the inertia"):
        read(tmp_path, no_body)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'type="revolute"',
            'type="screw"',
            "'hinge': unknown type 'screw'; known are fixed, prismatic, revolute",
        ),
        ('type="revolute"', "", "<joint> has no attribute 'type'"),
        ('child link="lid"', 'child link="lod"', "joint 'hinge' names the link 'lod'"),
        ("0.4, 0.6", "0.4", "link 'body': box size: expected 3 numbers, got '0.2 0.4'"),
        ('xyz="1, 2 3"', 'xyz="1 two 3"', "link 'body': origin xyz: expected 3 numbers"),
        ('xyz="1, 2 3"', 'xyz="1 nan 3"', "link 'body': origin xyz: expected 3 numbers"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint 'hinge': needs a <limit> and an axis"),
        ("<limit lower", "<limits lower", "joint 'hinge': needs a <limit>"),
        ('"0.02"', '"-0.02"', "joint 'hinge': damping is -0.02"),
        ('"0.3"', '"much"', "joint 'hinge': friction: expected 1 numbers, got 'much'"),
        ("<box size", "<sphere size", "link 'body': collision shapes must be boxes"),
        (
            '<link name="lid"/>',
            '<link name="lid"/><link name="more"/>',
            "one root link, found 2 (root, more)",
        ),
        ("</robot>", "", "not valid XML"),
    ],
)
def test_what_it_does_not_know_is_named(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    assert old in TEXT
    with refused(said=message) as error:
        read(tmp_path, TEXT.replace(old, new, 1))
    assert "thing.urdf" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<link name="lid"/>', '<link name="../../lid"/>', "must be a name"),
        ('xyz="1, 2 3"', 'xyz="1 1e300 3"', "origin xyz: expected 3 numbers"),
        ("0.4, 0.6", "0.4, 1e9", "box size: expected 3 numbers"),
    ],
)
def test_names_and_numbers_no_furniture_has(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    assert old in TEXT
    path = tmp_path / "thing.urdf"
    path.write_text(TEXT.replace(old, new))
    with refused(said=message):
        read_urdf(path)
