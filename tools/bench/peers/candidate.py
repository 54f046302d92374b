# SPDX-License-Identifier: Apache-2.0
"""A peer that was trained: its source text, how it was set, and what it answers on the computer it was
trained on."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np


@dataclass
class Candidate:
    """name, version of its library; note: settings, or why there is no program.

    sources {file name: text} that define peer_predict (none: it does not run on a microcontroller)
    include   folders of its library's headers; predicted [m, 2] degrees at the held-out features
    host      figures of a peer that runs on the host
    """

    name: str
    version: str
    note: str
    sources: dict = field(default_factory=dict)
    include: tuple = ()
    predicted: np.ndarray = None
    host: dict = field(default_factory=dict)


def write(candidates, path):
    """Store candidates in a JSON file, and their predictions beside it (.npz)."""
    path = Path(path)
    plain = [{**asdict(c), "predicted": None} for c in candidates]
    path.write_text(json.dumps(plain), encoding="utf-8")
    made = {str(i): c.predicted for i, c in enumerate(candidates) if c.predicted is not None}
    np.savez(path.with_suffix(".npz"), **made)


def read(path):
    """The candidates of a file that `write` made."""
    path = Path(path)
    candidates = [Candidate(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
    with np.load(path.with_suffix(".npz")) as made:
        for i, c in enumerate(candidates):
            c.predicted = made[str(i)] if str(i) in made.files else None
    return candidates


SCALED = """#include <avr/pgmspace.h>

static const float peer_origin[PEER_CHANNELS] PROGMEM = {origin};
static const float peer_gain[PEER_CHANNELS] PROGMEM = {gain};

static inline void peer_scale(const uint16_t *feature, {type} *x)
{{
    for (uint8_t j = 0; j < PEER_CHANNELS; j++)
        x[j] = (feature[j] - pgm_read_float(&peer_origin[j])) * pgm_read_float(&peer_gain[j]);
}}
"""


def c_float(value):
    """A C constant that is exactly this float32."""
    text = f"{np.float32(value):.9g}"
    return text + ("f" if "." in text or "e" in text else ".0f")


def c_array(values):
    """A C initialiser of a float array of one or two dimensions."""
    values = np.asarray(values)
    if values.ndim == 1:
        return "{ " + ", ".join(c_float(v) for v in values) + " }"
    return "{\n" + ",\n".join("    " + c_array(row) for row in values) + "\n}"


def scaling(origin, gain, kind="float"):
    """C text of peer_scale(feature, x): x_j = (feature_j - origin_j) gain_j."""
    return SCALED.format(origin=c_array(origin), gain=c_array(gain), type=kind)
