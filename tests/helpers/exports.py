"""Small captures as other programs export them, written from the descriptions of their formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from captures import orbit_pose, write_photo

COUNT, SIZE = 4, (24, 16)
POSES = np.stack([orbit_pose(0.3 + 0.7 * k)[:3] for k in range(COUNT)])  # camera to world, OpenGL axes
Y_UP = [1, 2, 0]  # rows of a pose for a world whose y axis points up
FOCAL, CENTER = (30.0, 31.0), (12.5, 7.5)
CHUNK_SCALE, CHUNK_SHIFT = 2.5, np.array([100.0, -20.0, 3.0])
CHUNK_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def write_polycam(folder: Path, kind: str = "corrected_") -> Path:
    """Return the first photo's calibration. kind: "corrected_", or "" for what the device recorded."""
    cameras = folder / f"keyframes/{kind}cameras"
    cameras.mkdir(parents=True, exist_ok=True)
    for k, pose in enumerate(POSES[:, Y_UP]):
        values: dict[str, Any] = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        values |= {"fx": FOCAL[0], "fy": FOCAL[1], "cx": CENTER[0], "cy": CENTER[1], "blur_score": 17.5}
        values |= {"width": SIZE[0], "height": SIZE[1]}
        (cameras / f"{1000 + k}.json").write_text(json.dumps(values))
        write_photo(folder / f"keyframes/{kind}images/{1000 + k}.jpg", SIZE, seed=k)
    return cameras / "1000.json"


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(x, y, z, w) by the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array([[a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g],
                  [g + c, h + f, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]])  # fmt: skip
    return np.linalg.eigh(k)[1][:, -1]


def record3d_document() -> dict[str, Any]:
    poses = [[*quaternion(pose[:, :3]).tolist(), *pose[:, 3].tolist()] for pose in POSES]
    matrix = [FOCAL[0], 0, 0, 0, FOCAL[1], 0, *CENTER, 1]  # column by column
    return {"w": SIZE[0], "h": SIZE[1], "K": matrix, "poses": poses, "fps": 60, "dw": 192, "dh": 256}


def write_record3d(folder: Path, name: str = "metadata.json", photos: str = "rgb") -> Path:
    for k in range(COUNT):
        write_photo(folder / photos / f"{k}.jpg", SIZE, seed=k)
    (folder / name).write_text(json.dumps(record3d_document()))
    return folder / name


def metashape_text(sensor: str = 'type="frame"', calibration: str = "", cameras: str = "") -> str:
    """Cameras in a chunk that is turned, scaled and shifted against the world."""
    listed = []
    for k, pose in enumerate(POSES):
        rotation = CHUNK_TURN.T @ (pose[:, :3] * (1, -1, -1))  # y down, z forward
        place = CHUNK_TURN.T @ (pose[:, 3] - CHUNK_SHIFT) / CHUNK_SCALE
        matrix = np.vstack([np.column_stack([rotation, place]), [0, 0, 0, 1]])
        text = " ".join(repr(float(v)) for v in matrix.ravel())
        listed.append(
            f'<camera id="{k}" sensor_id="0" component_id="0" label="DJI_{k:04}.JPG"><transform>{text}</transform>'
            "<orientation>1</orientation></camera>"
        )
    turn, shift = (" ".join(map(str, v.ravel())) for v in (CHUNK_TURN, CHUNK_SHIFT))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1"><sensor id="0" label="FC220" {sensor}><resolution width="24" height="16"/>'
        f'<calibration {sensor} class="adjusted"><f>31</f><b1>-1</b1><cx>0.5</cx><cy>-0.5</cy><k1>-0.02</k1>'
        f"<k2>0.01</k2><k3>-0.003</k3><p1>0.001</p1><p2>-0.002</p2>{calibration}</calibration></sensor></sensors>"
        '<components next_id="1"><component id="0" label="Component 1"><transform><rotation locked="true">'
        f"{turn}</rotation><translation>{shift}</translation><scale>{CHUNK_SCALE}</scale></transform></component>"
        f"</components><cameras>{''.join(listed)}{cameras}</cameras></chunk></document>\n"
    )


def write_metashape(folder: Path, text: str | None = None) -> Path:
    for k in range(COUNT):
        write_photo(folder / f"images/DJI_{k:04}.JPG", SIZE, seed=k)
    (folder / "cameras.xml").write_text(text or metashape_text(), encoding="utf-8")
    return folder / "cameras.xml"


HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"


def reality_text(**changes: object) -> str:
    """Rows of the export; keyword arguments replace a column's values."""
    lines = [HEADER]
    for k, pose in enumerate(POSES):
        r = pose[:, :3]
        heading, pitch = np.degrees(np.arctan2(r[0, 1], r[1, 1])), np.degrees(np.arcsin(r[2, 1]))
        roll = np.degrees(np.arctan2(-r[2, 0], r[2, 2]))
        x, y, alt = pose[:, 3].tolist()
        row: dict[str, object] = {"#name": f"a_{k}.png", "x": x, "y": y, "alt": alt}
        row |= {"heading": float(heading), "pitch": float(pitch), "roll": float(roll), "f": 30.0 * 36 / 24}
        row |= {"px": 0.5 / 24, "py": -0.5 / 24, "k1": -0.02, "k2": 0.01, "k3": -0.003, "k4": 0, "t1": 0, "t2": 0}
        lines.append(",".join(str(value) for value in (row | changes).values()))
    return "\r\n".join(lines) + "\r\n"


def write_realitycapture(folder: Path, text: str | None = None) -> Path:
    for k in range(COUNT):
        write_photo(folder / f"images/a_{k}.png", SIZE, seed=k)
    (folder / "poses.csv").write_text(text or reality_text(), encoding="utf-8", newline="")
    return folder / "poses.csv"


WRITERS = {
    "polycam": write_polycam,
    "record3d": write_record3d,
    "metashape": write_metashape,
    "realitycapture": write_realitycapture,
}
