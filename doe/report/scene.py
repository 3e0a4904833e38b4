"""An arm in space as scene.js draws it: its chain, the bodies of its cell, trackers, and measured errors as arrows."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from identification import Array, design_model, rms_distance

if TYPE_CHECKING:
    from identification import Arm

WHOLE = np.iinfo(np.uint16).max  # largest whole number of a vertex


def scene(model: Any, postures: Array, via: Sequence[Array], tests: Mapping[str, Any]) -> dict[str, Any]:
    """What scene.js draws of an arm at postures (m, n) [rad, mm], and of measurements.

    model : of the arm, as `design_model` gives it;  via : of each posture the (v, n) way-points on the way to it
    tests : name of measurements -> their `Validation`

    The chain is a list of n + 1 steps from frame to frame, each a fixed pose and then a motion about or along an
    axis, but for the last one, which leads to the measured point: joint_frames(q) are their products.
    """
    frames = model.joint_frames(np.zeros((1, model.joints)))[0]
    before = np.concatenate([np.eye(4)[None], frames[:-1]])
    moves = [{"axis": joint.axis.tolist(), "type": joint.type} for joint in model.arm.chain.joints]
    bodies = () if model.cell is None else model.cell.bodies
    most = 30_000 // max(len(bodies), 1)  # triangles of each: some 400 kB in all
    return {
        "chain": [
            {"pose": step[:3].ravel().tolist()} | move
            for step, move in zip(np.linalg.inv(before) @ frames, [*moves, {}], strict=True)
        ],
        "postures": np.asarray(postures).round(9).tolist(),
        "via": [each.tolist() for each in via],
        "bodies": [
            {"name": body.name, "joint": body.joint} | shape(looks, most)
            for body in bodies
            if len(looks := body.looks())
        ],
        "floor": None if model.cell is None else model.cell.floor,
        "trackers": [list(tracker) for tracker in trackers(model.arm)],
        "view": side(model.arm),
        "errors": [one for name, test in tests.items() for one in error_arrows(name, test)],
    }


def trackers(arm: Arm) -> list[tuple[float, ...]]:
    """Where the trackers stand [mm] that are to see the measured point."""
    return [one.tracker for one in arm.constraints if hasattr(one, "tracker")]


def side(arm: Arm) -> tuple[float, float]:
    """[deg] elevation and azimuth from which an arm in space is seen: its tracker stands behind it, to the right."""
    for tracker in trackers(arm):
        return 22.0, float(np.degrees(np.arctan2(tracker[1], tracker[0]))) - 130.0
    return 22.0, -60.0


def shape(triangles: Array, most: int) -> dict[str, Any]:
    """Triangles (t, 3, 3) as scene.js reads them, at most `most`: vertices are low + step * whole numbers."""
    vertices, faces = simplified(triangles, most)
    low, step = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-6) / WHOLE
    whole = np.round((vertices - low) / step).astype("<u2")
    texts = {name: b64encode(array.tobytes()).decode() for name, array in (("vertices", whole), ("faces", faces))}
    return {"low": low.tolist(), "step": step} | texts


def simplified(triangles: Array, most: int) -> tuple[Array, NDArray[np.uint16]]:
    """(v, 3) vertices and (f, 3) their numbers for triangles (t, 3, 3), of which at most `most` stay: vertices that are
    in one cell of a grid are one, at their mean (J. Rossignac, P. Borrel, "Multi-resolution 3D approximations", 1993);
    of few triangles only those that are equal.
    """
    vertices, faces = triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    low, size = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-6)
    weights = np.ones(len(vertices))  # of the vertices that are one, how many
    cells = 2.0**14 if len(triangles) <= most else 2.0 * most**0.5  # along the longest side
    while True:
        places = np.floor((vertices - low) * (cells / size)).astype(np.int64)
        _, number = np.unique(places @ [1 << 42, 1 << 21, 1], return_inverse=True)
        columns = weights, *(weights * vertices.T)
        weights, *sums = (np.asarray(np.bincount(number, weights=each), dtype=float) for each in columns)
        vertices = np.column_stack(sums) / weights[:, None]
        faces = number[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # not those that are a line now
        faces = faces[np.unique(faces @ [len(vertices) ** 2, len(vertices), 1], return_index=True)[1]]  # each once
        if len(faces) <= most and len(vertices) <= WHOLE:
            return vertices, faces.astype("<u2")
        cells *= 0.9


def error_arrows(name: str, test: Any) -> list[dict[str, Any]]:
    """What drawing and calibrated arm leave of measurements, as arrows in the frame of the arm's base; none where no
    points are measured.

    Measured positions are in the frame of the instrument. The rotation from there to the base is the one that brings
    the measured points nearest to those of the arm, for each session (W. Kabsch, Acta Crystallographica A32, 1976).

    name : of the measurements;  test : their `Validation`
    """
    arm, measured, residuals = test.arm, test.measurements, (test.nominal_residuals, test.residuals)
    if residuals[0].shape[1] < len("xyz") or not arm.chain.instrument.reads_positions:
        return []
    frames, tools = design_model(arm).joint_frames(measured.postures)[:, -1], dict(arm.chain.tools)
    tools |= {} if arm.calibration is None else arm.calibration.tools
    at = frames[:, :3, 3]
    if measured.marker is not None and len(tools) > 1:
        beside = np.array([tools[marker] - next(iter(tools.values())) for marker in measured.marker])
        at = at + np.einsum("mij,mj->mi", frames[:, :3, :3], beside)
    arrows = np.zeros((2, *at.shape))
    for rows in measured.session_rows:
        there, here = (each[rows] - each[rows].mean(axis=0) for each in (measured.positions[:, :3], at))
        left, _, right = np.linalg.svd(there.T @ here)
        turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0]) @ right
        arrows[:, rows] = [each[rows, :3] @ turn for each in residuals]
    shown = np.linspace(0, len(at) - 1, min(len(at), 500)).astype(int)  # more only cover each other
    models = [
        {"kind": kind, "name": model, "rms": rms_distance(left), "arrows": arrow[shown].round(5).tolist()}
        for kind, model, left, arrow in zip(
            ("before", "after"), ("drawing", "calibrated arm"), residuals, arrows, strict=True
        )
    ]
    return [{"name": name, "rows": len(at), "at": at[shown].round(2).tolist(), "models": models}]
