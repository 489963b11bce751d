# SPDX-License-Identifier: Apache-2.0
"""The discretised problem as plain arrays, so that any other solver can check a policy. docs/solver.md has the form."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.files import atomic_write
from iwm_power_manager.mdp.sweep import Model

#: Control of a state without a choice.
NO_CHOICE = -1


def export_mdp(model: Model, path: Path | str) -> None:
    """Write the problem as a NumPy archive, atomically; `ConfigError` if the folder cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays_of(model))
    atomic_write(path, buffer.getvalue())


def arrays_of(model: Model) -> dict[str, NDArray[Any]]:
    """The exact problem: one row for each power demand, cell and control.

    Returns
    -------
    dict
        discount : float64; demand : float64[G, P, P]; switching_j : float64[S, U]; cell_shape : int64[3];
        power, cell : int32[L], of a row; control : int16[L], `NO_CHOICE` where skid avoidance decides;
        cost_j : float64[L], without switching cost; successor : int32[L, 8], cells; weight : float64[L, 8], sums to 1.
    """
    controls = model.switching_j.shape[1]
    free = np.diff(model.free_start)
    # Stored demand by demand, in it control by control.
    power = np.repeat(np.arange(free.size), free * controls)
    cell = [
        np.tile(model.free_cell[a:b], controls) for a, b in zip(model.free_start, model.free_start[1:], strict=False)
    ]
    control = [np.repeat(np.arange(controls), n) for n in free]
    gated = np.diff(model.gated_start)
    corner = np.concatenate((model.free_corner, model.gated_corner))
    fraction = np.concatenate((model.free_fraction, model.gated_fraction))
    successor, weight = _corners(model.cell_shape, corner, fraction)
    return {
        "discount": np.array(model.discount),
        "demand": model.demand,
        "switching_j": model.switching_j,
        "cell_shape": np.array(model.cell_shape),
        "power": np.concatenate((power, np.repeat(np.arange(gated.size), gated))).astype(np.int32),
        "cell": np.concatenate((*cell, model.gated_cell)).astype(np.int32),
        "control": np.concatenate((*control, np.full(model.gated_cell.size, NO_CHOICE))).astype(np.int16),
        "cost_j": np.concatenate((model.free_cost, model.gated_cost)),
        "successor": successor,
        "weight": weight,
    }


def _corners(
    cell_shape: tuple[int, int, int], corner: NDArray[np.int32], fraction: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """The eight grid points around each next state, and their weights."""
    strides = (cell_shape[1] * cell_shape[2], cell_shape[2], 1)
    successor = np.empty((corner.size, 8), np.int32)
    weight = np.empty((corner.size, 8))
    for k in range(8):
        place = corner.astype(np.int64)
        part = np.ones(corner.size)
        for axis, (stride, points) in enumerate(zip(strides, cell_shape, strict=True)):
            upper = k >> axis & 1
            part *= fraction[:, axis] if upper else 1.0 - fraction[:, axis]
            if upper and points > 1:
                place += stride
        successor[:, k] = place
        weight[:, k] = part
    return successor, weight
