#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write the constant tables of the core: sg_gp_table.c, sg_mlp_table.c, sg_expose_table.h, sg_crc32_table.h.

    python3 firmware/core/make_tables.py            write them beside this script
    python3 firmware/core/make_tables.py --check    exit 1 if a committed file differs
"""
import math
import os
import sys

# The node, nominal (the virtual Nano's parts scatter around it; calibration absorbs a part's own constant).
JUNCTION_PF = 40.0        # C0, at zero bias
JUNCTION_V = 0.7          # C(V) = C0 / (1 + V / 0.7 V) ** 0.4
JUNCTION_POWER = 0.4
PIN_PF = 6.0
SAMPLE_HOLD_PF = 14.0
SUPPLY_V = 5.0
CODES_Q2 = 4096           # sum of four readings of 10 bits: quarters of an ADC step
TIMER_HZ = 16.0e6
UNIT_A = 62.5e-12         # feature 0
FEATURE_PER_OCTAVE = 4096

# Of all charge on the node. The sample capacitor joins last and lifts what is nearly empty: 0.64 can be told
# apart, and a window of WINDOW_RATIO above the goal must fit into it.
GOAL_FRACTION = 0.30
WINDOW_RATIO = 2.1        # either way; above the 1.9 that gaze alone moves the light

LICENSE = "// SPDX-License-Identifier: Apache-2.0\n"
MADE_BY = "// Made by make_tables.py; edit that.\n"


def node_charge_pc(volts):
    """Charge on the node at a reverse voltage, pC: F(V) = Qj(V) + (C_pin + C_sh) V."""
    power = 1.0 - JUNCTION_POWER
    junction = JUNCTION_PF * JUNCTION_V / power * ((1.0 + volts / JUNCTION_V) ** power - 1.0)
    return junction + (PIN_PF + SAMPLE_HOLD_PF) * volts


def collected_pc(code_q2):
    """Charge collected when the node ends at a reading in quarters of a code (may be fractional), pC."""
    return node_charge_pc(SUPPLY_V) - node_charge_pc(SUPPLY_V * code_q2 / CODES_Q2)


def code_at(charge_pc):
    """Reading, in quarters of a code, at which a charge has been collected, by bisection; fractional."""
    low, high = 0.0, float(CODES_Q2)
    for _ in range(60):
        middle = (low + high) / 2
        if collected_pc(middle) > charge_pc:
            low = middle
        else:
            high = middle
    return low


def rounded(x):
    """Half up, also for negative numbers."""
    return math.floor(x + 0.5)


def exp_table():
    """2^16 exp(-i / 128), i = 0..1663, Q0.16; zeros behind the last that is not.

    The device goes on from a node along its tangent, with the upper byte of the level only."""
    level = [math.floor(65536 * math.exp(-i / 128)) for i in range(1664)]
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
    return (LICENSE + MADE_BY + '#include "sg_gp_loop.h"\n#include "sg_rom.h"\n\n'
            "const uint16_t sg_gp_exp_table[SG_GP_EXP_ENTRIES] SG_ROM = {\n" + rows(exp_table()) + "};\n")


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


def capacitance_log2():
    """log2 of the mean capacitance over a drop of 16*i codes (64*i quarters), with every constant of the feature, Q4.12."""
    per_quarter_v = SUPPLY_V / CODES_Q2
    nodes = []
    for i in range(65):
        drop = max(64 * i, 1e-6)
        mean_pf = collected_pc(CODES_Q2 - drop) / (drop * per_quarter_v)
        per_quarter_c = mean_pf * 1e-12 * per_quarter_v
        nodes.append(rounded(FEATURE_PER_OCTAVE * math.log2(per_quarter_c * TIMER_HZ / UNIT_A)))
    return nodes


def expose_table():
    """Text of sg_expose_table.h."""
    mantissa = [rounded(FEATURE_PER_OCTAVE * math.log2(1 + i / 64)) for i in range(65)]
    goal_pc = node_charge_pc(SUPPLY_V) * GOAL_FRACTION
    goal_feature = rounded(FEATURE_PER_OCTAVE * math.log2(goal_pc * 1e-12 * TIMER_HZ / UNIT_A))
    return (LICENSE + MADE_BY + "#ifndef SG_EXPOSE_TABLE_H\n#define SG_EXPOSE_TABLE_H\n\n"
            '#include <stdint.h>\n\n#include "sg_rom.h"\n\n'
            "// 4096 * log2(1 + i / 64)\n"
            "static const uint16_t log2_mantissa_q12[65] SG_ROM = {\n" + rows(mantissa) + "};\n\n"
            "// 4096 * log2(mean capacitance over a drop of 64 * i quarter codes), so that the sum is a feature\n"
            "static const uint16_t log2_capacitance_q12[65] SG_ROM = {\n" + rows(capacitance_log2()) +
            "};\n\n// The charge to aim at: the feature it would have after 1 cycle. Where the window ends.\n"
            f"#define GOAL_Q12 {goal_feature}L\n"
            f"#define BRIGHT_CODE_Q2 {rounded(code_at(goal_pc * WINDOW_RATIO))}U  // goal * {WINDOW_RATIO}\n"
            f"#define DIM_CODE_Q2 {rounded(code_at(goal_pc / WINDOW_RATIO))}U  // goal / {WINDOW_RATIO}\n"
            "\n#endif\n")


def crc32_table():
    """Text of sg_crc32_table.h: CRC-32 (IEEE 802.3, reflected) of every byte."""
    values = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
        values.append(f"0x{crc:08X}")
    return (LICENSE + MADE_BY + "#ifndef SG_CRC32_TABLE_H\n#define SG_CRC32_TABLE_H\n\n"
            '#include <stdint.h>\n\n#include "sg_rom.h"\n\n'
            "static const uint32_t crc32_table[256] SG_ROM = {\n" + rows(values, 8) + "};\n\n#endif\n")


def main(argv):
    """Write or check; returns the exit code."""
    here = os.path.dirname(os.path.abspath(__file__))
    stale = []
    tables = {"sg_gp_table.c": gp_table, "sg_mlp_table.c": mlp_table, "sg_expose_table.h": expose_table,
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
