#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write the constant tables of the core: sg_gp_table.c, sg_mlp_table.c, sg_light_table.[ch],
sg_crc32_table.h.

    python3 firmware/core/make_tables.py            write them beside this script
    python3 firmware/core/make_tables.py --check    exit 1 if a committed file differs
"""
import cmath
import math
import os
import sys

# The node, nominal (the virtual Nano's parts scatter around it; calibration absorbs a part's own constant).
JUNCTION_PF = 40.0        # C0, at zero bias
JUNCTION_V = 0.7          # C(V) = C0 / (1 + V / 0.7 V) ** 0.4
JUNCTION_POWER = 0.4
PIN_PF = 6.0
SAMPLE_HOLD_PF = 14.0
RAIL_V = 1.8              # what the cathodes rest on
REFERENCE_V = 1.1
TIMER_HZ = 16.0e6
UNIT_A = 62.5e-12         # feature 0
FEATURE_PER_OCTAVE = 4096
CODE_UNIT = 32            # charges and codes are counted in 1/32 of a code

# Ambient light: weights near those exact at this frequency, least wrong at 100 and 120 Hz. An unlit sample
# comes 3 of 18 slots after the lit one.
FLICKER_HZ = 110.0
LIT_BEFORE_UNLIT = 3.0 / 18.0
PERIOD_FROM, PERIOD_STEP, PERIOD_NODES = 15984, 2048, 9

# Of one code, rms, at an ADC clock of 250 kHz. Means of less than 40/32 are raised by codes that cannot be
# negative.
NOISE_LSB = 0.755
CLIPPED_NODES, CLIPPED_OFFSET = 40, 128

EXP_WORDS = 384           # of the kernel's table: from here on a byte holds the level

LICENSE = "// SPDX-License-Identifier: Apache-2.0\n"
MADE_BY = "// Made by make_tables.py; edit that.\n"


def rounded(x):
    """Half up, also for negative numbers."""
    return math.floor(x + 0.5)


def exp_table():
    """2^16 exp(-i / 64), i = 0..710, Q0.16; the last is 0.

    The device goes on from a node along its tangent, with the upper byte of the level only."""
    level = [math.floor(65536 * math.exp(-i / 64)) for i in range(711)]
    level[0] = 65535
    return level


def rows(values, per_row=12):
    """Numbers as C initialiser lines."""
    lines = []
    for i in range(0, len(values), per_row):
        lines.append("    " + ", ".join(str(v) for v in values[i:i + per_row]) + ",\n")
    return "".join(lines)


def gp_table():
    """Text of sg_gp_table.c."""
    words, tail = exp_table()[:EXP_WORDS], exp_table()[EXP_WORDS:]
    return (LICENSE + MADE_BY + '#include "sg_gp_loop.h"\n#include "sg_rom.h"\n\n'
            "const uint16_t sg_gp_exp_table[SG_GP_EXP_WORDS] SG_ROM = {\n" + rows(words) + "};\n\n"
            "const uint8_t sg_gp_exp_tail[SG_GP_EXP_BYTES] SG_ROM = {\n" + rows(tail, 18) + "};\n")


def tanh_table():
    """[level Q0.15] of tanh(i ln 2 / 32), i = 0..256.

    The chord lies below the curve: half of its greatest height, second derivative * step^2 / 8, goes onto the
    nodes."""
    step = math.log(2.0) / 32
    values = []
    for i in range(257):
        t = math.tanh(i * step)
        values.append(min(rounded(32768 * (t + t * (1 - t * t) * step * step / 8)), 32767))
    return values


def mlp_table():
    """Text of sg_mlp_table.c."""
    return (LICENSE + MADE_BY + '#include "sg_mlp_loop.h"\n#include "sg_rom.h"\n\n'
            "const uint16_t sg_mlp_tanh_table[257] SG_ROM = {\n" + rows(tanh_table()) + "};\n")


def capacitance_at_rest_pf():
    """Of a node at 0 V, the sample capacitor included."""
    return JUNCTION_PF * (1.0 + RAIL_V / JUNCTION_V) ** -JUNCTION_POWER + PIN_PF + SAMPLE_HOLD_PF


def charge_codes(code):
    """Charge on a node that reads `code`, in codes at the capacitance at rest."""
    power = 1.0 - JUNCTION_POWER

    def junction_pc(reverse):
        return JUNCTION_PF * JUNCTION_V / power * (1.0 + reverse / JUNCTION_V) ** power

    volts = REFERENCE_V * code / 1024
    charge_pc = junction_pc(RAIL_V) - junction_pc(RAIL_V - volts) + (PIN_PF + SAMPLE_HOLD_PF) * volts
    return charge_pc / (capacitance_at_rest_pf() * REFERENCE_V / 1024)


def curvature():
    """(k1, k2) of charge = code (1 + k1 x + k2 x^2), x = code / 1024: least squares over codes 0..1000."""
    sums = [[0.0] * 3 for _ in range(2)]
    for code in range(1001):
        x = code / 1024
        basis = (code * x, code * x * x)
        excess = charge_codes(code) - code
        for i in range(2):
            for j in range(2):
                sums[i][j] += basis[i] * basis[j]
            sums[i][2] += basis[i] * excess
    (a, b, e), (c, d, f) = sums
    return (e * d - b * f) / (a * d - b * c), (a * f - e * c) / (a * d - b * c)


def flicker_weights(period_cycles):
    """(b, c) of sg_light.h: weights of the previous unlit code and of the one before it."""
    turn = 2 * math.pi * FLICKER_HZ * period_cycles / TIMER_HZ
    back = turn * LIT_BEFORE_UNLIT
    before = math.sin(back / 2) * math.sin(turn - back / 2) / math.sin(turn / 2) ** 2
    earlier = -math.sin(back / 2) * math.sin((turn - back) / 2) / (math.sin(turn) * math.sin(turn / 2))
    return before, earlier


def flicker_left(before_q8, earlier_q8, period_cycles, hz):
    """What these weights, b and -c in 1/256, leave of flicker, of its amplitude."""
    turn = cmath.exp(-2j * math.pi * hz * period_cycles / TIMER_HZ)
    back = cmath.exp(-2j * math.pi * hz * period_cycles / TIMER_HZ * LIT_BEFORE_UNLIT)
    before, earlier = before_q8 / 256, -earlier_q8 / 256
    return abs(1 - before - earlier + before * turn + earlier * turn * turn - back)


def flicker_weights_q8(period_cycles):
    """(b, -c) in 1/256 beside those exact at 110 Hz that leave least of 100 and 120 Hz, the worse of both."""
    before, earlier = flicker_weights(period_cycles)
    near = [(rounded(256 * before) + i, rounded(-256 * earlier) + j)
            for i in range(-2, 3) for j in range(-2, 3)]
    return min(near, key=lambda pair: max(flicker_left(*pair, period_cycles, hz) for hz in (100.0, 120.0)))


def light_table():
    """Text of sg_light_table.h."""
    unit_a = capacitance_at_rest_pf() * 1e-12 * REFERENCE_V / 1024 / CODE_UNIT * TIMER_HZ
    weights = [flicker_weights_q8(PERIOD_FROM + PERIOD_STEP * i) for i in range(PERIOD_NODES)]
    k1, k2 = curvature()
    return (LICENSE + MADE_BY + "#ifndef SG_LIGHT_TABLE_H\n#define SG_LIGHT_TABLE_H\n\n"
            f"// Feature of 1/{CODE_UNIT} code collected in 1 cycle.\n"
            f"#define UNIT_Q12 {rounded(FEATURE_PER_OCTAVE * math.log2(unit_a / UNIT_A))}L\n\n"
            "// Curvature of sg_light_loop.c, Q0.16: 2 k1; the same and half a step of x in 3 k2 x; a step of that;\n"
            "// k2 over 256, as a power of two.\n"
            f"#define TWICE_K1_Q16 {rounded(2 * k1 * 65536)}\n"
            f"#define SG_LIGHT_SLOPE_Q16 {rounded(2 * k1 * 65536 + 3 * k2 * 128)}\n"
            f"#define SG_LIGHT_CUBIC {rounded(3 * k2 * 256)}\n"
            f"#define SG_LIGHT_SQUARE_SHIFT {rounded(math.log2(k2 * 256))}\n\n"
            "// Share of the sample capacitor in the capacitance at rest, Q0.16.\n"
            f"#define SHARE_Q16 {rounded(SAMPLE_HOLD_PF / capacitance_at_rest_pf() * 65536)}\n\n"
            f"// Weights of earlier unlit codes by period, nearest of every {PERIOD_STEP} cycles from {PERIOD_FROM} on: b\n"
            "// and -c of sg_light.h, Q0.8.\n"
            f"#define PERIOD_FROM {PERIOD_FROM}U\n#define PERIOD_BITS {PERIOD_STEP.bit_length() - 1}\n"
            f"#define PERIOD_NODES {PERIOD_NODES}\n"
            f"#define BEFORE_Q8 {{ {', '.join(str(b) for b, _ in weights)} }}\n"
            f"#define EARLIER_MINUS_Q8 {{ {', '.join(str(c) for _, c in weights)} }}\n\n#endif\n")


def rectified(level, noise):
    """Mean code of a level, in codes, under noise (rms) when nothing below 0 is read: sum over thresholds."""
    return sum(0.5 * math.erfc((code - 0.5 - level) / noise / math.sqrt(2)) for code in range(1, 12))


def unclipped():
    """[level, 1/32 code] behind a mean code of i / 32, i = 0..39; a mean of 0 is taken as 0.1 / 32."""
    levels = []
    for i in range(CLIPPED_NODES):
        low, high = -4.0, 4.0
        for _ in range(50):
            middle = (low + high) / 2
            below = rectified(middle, NOISE_LSB) < max(i, 0.1) / CODE_UNIT
            low, high = (middle, high) if below else (low, middle)
        levels.append(rounded(low * CODE_UNIT))
    return levels


def log2_table():
    """Text of sg_light_table.c. The last entry is one less, so that no logarithm reaches the next octave."""
    mantissa = [rounded(FEATURE_PER_OCTAVE * math.log2(1 + i / 64)) for i in range(64)]
    mantissa.append(FEATURE_PER_OCTAVE - 1)
    return (LICENSE + MADE_BY + '#include "sg_light_loop.h"\n#include "sg_rom.h"\n\n'
            "const uint16_t sg_light_log2_table[65] SG_ROM = {\n" + rows(mantissa) + "};\n\n"
            "const uint8_t sg_light_clipped_table[SG_LIGHT_CLIPPED_Q5] SG_ROM = {\n"
            + rows([CLIPPED_OFFSET + level for level in unclipped()], 20) + "};\n")


def crc32_table():
    """Text of sg_crc32_table.h: CRC-32 (IEEE 802.3, reflected) of every half byte."""
    values = []
    for nibble in range(16):
        crc = nibble
        for _ in range(4):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
        values.append(f"0x{crc:08X}")
    return (LICENSE + MADE_BY + "#ifndef SG_CRC32_TABLE_H\n#define SG_CRC32_TABLE_H\n\n"
            '#include <stdint.h>\n\n#include "sg_rom.h"\n\n'
            "static const uint32_t crc32_table[16] SG_ROM = {\n" + rows(values, 8) + "};\n\n#endif\n")


def main(argv):
    """Write or check; returns the exit code."""
    here = os.path.dirname(os.path.abspath(__file__))
    stale = []
    tables = {"sg_gp_table.c": gp_table, "sg_mlp_table.c": mlp_table, "sg_light_table.h": light_table,
              "sg_light_table.c": log2_table,
              "sg_crc32_table.h": crc32_table}
    for name, make in tables.items():
        text = make()
        path = os.path.join(here, name)
        if argv == ["--check"]:
            with open(path, encoding="utf-8") as file:
                if file.read() != text:
                    stale.append(name)
        else:
            with open(path, "w", encoding="utf-8") as file:
                file.write(text)
    for name in stale:
        print(f"{name} is not what make_tables.py makes", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
