# SPDX-License-Identifier: Apache-2.0
"""When the firmware lights the emitters, in cycles of its clock: what eye safety and power are computed from.

A sensing cycle has PHASES phases of SLOTS_A_PHASE conversions each, `slot_cycles` apart. In a phase two
sensors are sampled lit, in slots 1 and 2, and unlit in slots 4 and 5. Lights go on a little before the
earlier release and out after the second sample. The constants are those of firmware/ports/avr328p; a test
compares them, and another one what the virtual Nano counts.
"""

from dataclasses import dataclass
from typing import Optional, Tuple

import numpy as np

CPU_HZ = 16_000_000
PHASES, SLOTS_A_PHASE = 3, 6
SLOT_CYCLES, SLOT_CYCLES_MAX = 888, 1777
EXPOSURE_SLOTS = (2, 3)  # the longest exposure of a phase's first and second sensor ends this long after
EXPOSURE_LESS_CYCLES = 120  # the slot before, less these
LIGHTS_AHEAD_CYCLES = 120  # lights on before the earlier release, at the most
DARK_AFTER_CYCLES = 32  # lights out after the second sample
LATE_CYCLES = 96  # later by the longest other interrupt, now and then
WATCHDOG_MS = 128  # 16,384 periods of 128 kHz: what the compiler's library calls 120 ms
WATCHDOG_SPREAD = 0.10  # its oscillator, part to part and over supply and temperature
LOCKOUT_MS = 1000  # dark after the watchdog had to reset
CLOCK_SPREAD = 0.01  # the resonator


@dataclass(frozen=True)
class Timing:
    """How the device senses.

    slot_cycles       between two conversions, SLOT_CYCLES..SLOT_CYCLES_MAX
    exposure_cycles   of a phase's first and second sensor; None: the longest
    repeats           sensing cycles in a frame
    frame_cycles      from frame to frame, dark after the last cycle; 0: cycles without a pause
    """

    slot_cycles: int = SLOT_CYCLES
    exposure_cycles: Optional[Tuple[int, int]] = None
    repeats: int = 1
    frame_cycles: int = 0

    @property
    def period_cycles(self):
        """Of one sensing cycle."""
        return PHASES * SLOTS_A_PHASE * self.slot_cycles

    @property
    def frame_period_cycles(self):
        """From frame to frame."""
        return max(self.frame_cycles, self.repeats * self.period_cycles)

    @property
    def rate_hz(self):
        """Frames a second of device time."""
        return CPU_HZ / self.frame_period_cycles

    @property
    def longest_exposures(self):
        """Of a phase's first and second sensor, cycles."""
        return tuple(slots * self.slot_cycles - EXPOSURE_LESS_CYCLES for slots in EXPOSURE_SLOTS)

    def lit_cycles(self, late=0):
        """How long the lights of a phase are on, once a cycle."""
        first, second = (
            min(pair) for pair in zip(self.exposure_cycles or self.longest_exposures, self.longest_exposures)
        )
        return LIGHTS_AHEAD_CYCLES + max(first + self.slot_cycles, second) + DARK_AFTER_CYCLES + late

    def lit_s(self, late=0):
        """The same in seconds."""
        return self.lit_cycles(late) / CPU_HZ

    def phase_duty(self, late=0):
        """Part of all time in which the lights of one phase are on."""
        return self.lit_cycles(late) * self.repeats / self.frame_period_cycles

    def emitter_duty(self, headset, late=0):
        """Part of all time in which each emitter is lit, [emitter]."""
        return self.phase_duty(late) * lights(headset).sum(0)


def lights(headset):
    """bool [phase, emitter]: who is lit in each phase of the firmware. Of a headset without phases:
    everybody, always, which is the most there can be.
    """
    lit = np.ones((PHASES, len(headset.emitters)), bool)
    if headset.phases:
        lit[:] = False
        for row, phase in zip(lit, headset.phases):
            row[list(phase.light)] = True
    return lit
