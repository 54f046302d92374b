# SPDX-License-Identifier: Apache-2.0
"""Latency in exact cycles, from the virtual Nano's log of pins, samples and sent bytes (`frames on`).

Rows event,cycle: lit:<mask> emitters that light from then on; drive<i>:<how> pin i (3: floating);
adc:<channel> the instant of a sample; delimiter the end of a sent packet's last byte. A sensing cycle has
six lit samples of channels 0..5 and six unlit ones; a frame's time is the mean of the middles of its six
lit exposures.
"""

import csv

import numpy as np

from sparsegaze.errors import SparsegazeError

CYCLES_PER_MS = 16_000.0
FLOATING = 3
CHANNELS, SAMPLES = 6, 12
FIRST = 5  # sensor of the first lit sample of a cycle


def read(path):
    """[(event, cycle)] of a log."""
    with open(path, newline="", encoding="ascii") as file:
        return [(row["event"], int(row["cycle"])) for row in csv.DictReader(file)]


def cycles_of(rows):
    """(mean [n], last [n], sent [m]): mean sample time and last sample of every sensing cycle, ends of
    packets."""
    lit, released, sent = 0, {}, []
    mean, last = [], []
    middles = samples = None  # of the cycle under way; None until a first one begins
    for event, cycle in rows:
        kind, _, value = event.partition(":")
        if kind == "lit":
            lit = int(value)
        elif kind.startswith("drive"):
            if int(value) == FLOATING:
                released[int(kind[5:])] = cycle
        elif kind == "delimiter":
            sent.append(cycle)
        elif kind == "adc" and int(value) < CHANNELS:
            channel = int(value)
            if lit and channel == FIRST:
                middles, samples = [], 0
            if middles is None or channel not in released:
                continue
            samples += 1
            if lit:
                middles.append((released[channel] + cycle) / 2)
            if samples == SAMPLES and len(middles) == CHANNELS:
                mean.append(np.mean(middles))
                last.append(cycle)
                middles = None
    return np.array(mean), np.array(last), np.array(sent)


def latency(path, infer_us=0):
    """Milliseconds of device time from mean and last sample to the last byte of the gaze, mean and
    maximum; and how evenly the last samples follow each other.

    infer_us   the least of what the device says lay between a frame's last sample and its inference: the
               packet of the frame before may end after the last sample too, but before that
    Of frames after which just one packet was sent before the next was due: answers to pings are left out.
    """
    mean, last, sent = cycles_of(read(path))
    ready = last + infer_us * CYCLES_PER_MS / 1000
    first = np.searchsorted(sent, ready[:-1], side="right")
    alone = np.searchsorted(sent, ready[1:], side="right") - first == 1
    if not alone.any():
        raise SparsegazeError(
            "no frame in the virtual Nano's log whose bytes can be told apart", "run it longer"
        )
    ends = sent[first[alone]]
    from_mean = (ends - mean[:-1][alone]) / CYCLES_PER_MS
    from_last = (ends - last[:-1][alone]) / CYCLES_PER_MS
    period = np.diff(last)
    return {
        "frames": int(alone.sum()),
        "period_cycles": int(np.median(period)),
        "jitter_cycles": int(np.ptp(period[period < 1.5 * np.median(period)])),
        "latency_mean_ms": float(from_mean.mean()),
        "latency_mean_max_ms": float(from_mean.max()),
        "latency_last_ms": float(from_last.mean()),
        "latency_last_max_ms": float(from_last.max()),
    }
