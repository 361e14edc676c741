"""Files of laws that contain the delay of their inputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.names import input_keys
from fflin.base.record import figure, read_record, reading, text, texts
from fflin.linear.model import LinearModel

# Kind of the files of laws that `tune` found.
TUNED = "Tuned"


def in_time_of_file(path: Path, lin: LinearModel) -> LinearModel:
    """Return a model with the sample time and the delay of the tuned law in a file.

    The model does not change if the file contains another controller, or a law without a delay.
    """
    with reading(path, "controller"):
        record, _ = read_record(path)
    if "delay" not in record or text(record.get("kind", "")) != TUNED or lin.dt:
        return lin
    return in_time_of(record, lin)


def in_time_of(record: Mapping[str, Any], lin: LinearModel) -> LinearModel:
    """Return a continuous model with the sample time and the delay of a tuned law."""
    delays = np.asarray(record["delay"], float).ravel()
    if not delays.any():
        return lin
    by_input = dict(zip(texts(record["output_names"]), delays.tolist(), strict=True))
    keys = dict(zip(lin.input_names, input_keys(lin), strict=True))
    named = {keys[name]: value for name, value in by_input.items() if name in keys}
    return lin.discretize(figure(record["dt"]), delay=named)
