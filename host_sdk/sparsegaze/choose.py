# SPDX-License-Identifier: Apache-2.0
"""How many calibration vectors a device model gets, and what they cost."""

import numpy as np

from .errors import ModelError
from .model import HEAD_BYTES, RECORD_BYTES
from .trust import NODE_BYTES
from .trustfit import CELLS_MAX
from .wire import ffi, lib

# Cycles of an inference on the ATmega328P with the assembly loop, as `sparsegaze predict --on nano` counts
# them, the same for every input: those of a model without vectors, and of a vector.
# tests/unit/test_fit_choice.py holds them against tests/budget.csv.
CYCLES_BASE, CYCLES_EACH = 2770, 157.5
NANO_SLOT_BYTES = 1536  # of one of the Nano's two model slots, as its firmware says in HELLO
CELLS_LEAST = 5  # per axis, of the grid of what to expect: cells of some 9 degrees
ROOM = (NANO_SLOT_BYTES - HEAD_BYTES - NODE_BYTES * (CELLS_LEAST + 1) ** 2) // RECORD_BYTES
MOST = 64  # vectors chosen without being asked for: past this nothing is gained, and the grid gets coarser
AIM_DEG = 0.05  # rms distance to the full process
LOSS = 1.05  # and the truth error may be this much the full process's
FINE_DEG = 0.01  # rms distance below which more vectors change nothing: the output has steps of 1/128 deg


def cycles(vectors):
    """Cycles of an inference on the Nano, features in to gaze out."""
    return int(np.ceil(CYCLES_BASE + CYCLES_EACH * vectors))


def cells(vectors):
    """Cells per axis of the largest grid that a slot of the Nano has room for beside so many vectors."""
    left = NANO_SLOT_BYTES - HEAD_BYTES - RECORD_BYTES * vectors
    return int(np.clip(np.sqrt(max(left, 0) // NODE_BYTES) - 1, 1, CELLS_MAX))


def rate_limit_hz(vectors, features=False, counts=False, recentred=False, repeats=1):
    """Frames a second that the Nano will reach with a model of so many vectors and the gaze streamed.

    features, counts   streamed as well;  recentred  a correction is in force;  repeats  cycles in a frame
    The device's own arithmetic (shortest() of firmware/app/app_rate.c) on its own constants, in normal power.
    """
    cost = lib.COST_SENSE + lib.COST_FRAME + lib.COST_REQUEST + lib.COST_GAZE
    cost += recentred * lib.COST_RECENTRE + features * lib.COST_RAW + counts * lib.COST_COUNTS
    inference = lib.COST_MODEL + lib.COST_VECTOR * vectors
    work_us = cost // lib.CYCLES_PER_US + 1 + inference // lib.CYCLES_PER_US + 1
    last_us = max(work_us, lib.PERIOD_LEAST_US)
    frame_us = last_us + (repeats - 1) * min(last_us, lib.PERIOD_MOST_US)
    streams = ["struct sg_gaze"] + ["struct sg_raw"] * features + ["struct sg_counts"] * counts
    line_us = sum(ffi.sizeof(stream) + lib.PACKET_BYTES for stream in streams) * lib.BYTE_US
    return 1_000_000 // max(frame_us, line_us + line_us // 8)


def rates_hz(vectors):
    """What `rate_limit_hz` says of a model in the cases that a user meets, {case: Hz}."""
    return {
        "gaze": rate_limit_hz(vectors),
        "recentred": rate_limit_hz(vectors, recentred=True),
        "features": rate_limit_hz(vectors, features=True),
    }


def vectors_at(rate_hz):
    """The most vectors with which the Nano reaches this rate, 0 if it does with none."""
    return max((n for n in range(1, ROOM + 1) if rate_limit_hz(n) >= rate_hz), default=0)


def most_vectors(budget_cycles=None, n_vectors=None, rate_hz=None):
    """Vectors to make at most, from a wish, a budget and a rate (each may be None). Raises ModelError."""
    if n_vectors is not None and not 1 <= n_vectors <= ROOM:
        raise ModelError(f"{n_vectors} vectors do not fit the device", f"ask for 1 to {ROOM}")
    most = n_vectors or (MOST if budget_cycles is None else ROOM)
    least = n_vectors or 1
    if budget_cycles is not None:
        fitting = int((budget_cycles - CYCLES_BASE) // CYCLES_EACH)
        if fitting < least:
            what = f"{n_vectors} vectors" if n_vectors else "not even one vector"
            raise ModelError(
                f"{what} in {budget_cycles} cycles: that is too few",
                f"give at least --budget-cycles {cycles(least)}",
            )
        most = min(most, fitting)
    if rate_hz is not None:
        fitting = vectors_at(rate_hz)
        if fitting < least:
            reached = rate_limit_hz(least)
            remedy = f"ask for --rate {reached} at most"
            if n_vectors and fitting:
                remedy += f", or --vectors {fitting}"
            elif not fitting:
                remedy += f", which it reaches with up to {vectors_at(rate_limit_hz(1))} vectors"
            what = f"{n_vectors} vectors do" if n_vectors else "the device does"
            raise ModelError(f"{rate_hz} Hz is too fast: {what} {reached} Hz at most", remedy)
        most = min(most, fitting)
    return most


def aim_deg(loo_deg, budget_cycles=None, rate_hz=None):
    """Rms distance from the full process, degrees, at which more vectors are of no use.

    loo_deg  leave-one-fixation-out error of the full process. A distance independent of its error adds as
    squares do; together they may be LOSS times the error. With a budget in cycles, or a rate, the vectors
    are there to be used: the aim is then FINE_DEG.
    """
    if budget_cycles is not None or rate_hz is not None:
        return FINE_DEG
    return float(min(AIM_DEG, loo_deg * np.sqrt(LOSS**2 - 1.0)))
