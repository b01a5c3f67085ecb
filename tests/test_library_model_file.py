"""Model files that pgdm writes, with the meshes that they refer to."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from pgdm.library.files import model


def test_meshes_of_one_name_stay_different_files(tmp_path: Path) -> None:
    folders = ("a", "b/x", "c/x", "c/x")
    for folder in folders:
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / "m.stl").write_text(folder)
    files = "".join(f'<mesh file="{tmp_path / folder / "m.stl"}"/>' for folder in folders)
    written = tmp_path / "out" / "model.xml"
    copied = model.write(ET.fromstring(f"<mujoco><asset>{files}</asset></mujoco>"), written, "")
    refers = [mesh.attrib["file"] for mesh in ET.parse(written).iter("mesh")]
    assert [(written.parent / name).read_text() for name in refers] == list(folders)
    assert len(copied) == len(set(refers)) == 3
