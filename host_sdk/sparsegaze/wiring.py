# SPDX-License-Identifier: Apache-2.0
"""How a headset hangs on a Nano: which pins, and what the firmware expects there.

wiring = "leds"          LEDs sense and emit. Pin A0..A5, resistor, anode; all cathodes on a quiet rail.
wiring = "photodiodes"   six photodiodes, anodes on A0..A5, cathodes on the rail; emitters on D2..D4, anode
                         through the resistor, cathode to ground.

Channel i of the device is pin Ai. A file without [board] wiring describes optics only; pins that it names all
the same have to exist and to be named once.
"""

from .errors import SceneError

ANALOG = tuple("A%d" % i for i in range(8))
DIGITAL = tuple("D%d" % i for i in range(2, 14))  # D0 and D1 are the serial line's
CHANNELS = ANALOG[:6]
EMITTERS = {"leds": CHANNELS, "photodiodes": ("D2", "D3", "D4")}
SUPPLY_PIN = "A7"
# Who senses, and who is lit meanwhile: what the firmware does, phase by phase.
PHASES = {
    "leds": (((5, 0), (1, 2, 3, 4)), ((1, 4), (0, 2, 3, 5)), ((2, 3), (0, 1, 4, 5))),
    "photodiodes": (((0, 3), (0,)), ((1, 4), (1,)), ((2, 5), (2,))),
}
# (key, least, most): numbers of [board]
_NUMBERS = (("rail_volts", 0.0, 5.0), ("rail_ohm", 0.0, 100.0), ("rail_noise_mv", 0.0, 100.0))


def check_wiring(headset, file):
    """SceneError, naming the entries, when pins clash or the firmware could not drive them.

    headset   Headset          file   its name, for the message
    """
    board = headset.board
    for key, low, high in _NUMBERS:
        value = board.get(key, low)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            raise SceneError(
                "%s: board: %s = %r is not in %g..%g" % (file, key, value, low, high), "correct it"
            )
    _check_pins(headset, file)
    if "wiring" not in board:
        return
    kind = board["wiring"]
    if not isinstance(kind, str) or kind not in EMITTERS:
        raise SceneError(
            "%s: board: there is no wiring %r" % (file, kind), 'write wiring = "leds" or "photodiodes"'
        )
    _check_kind(headset, file, kind)
    _check_order(headset.sensors, CHANNELS, "sensor", file, kind)
    _check_order(headset.emitters, EMITTERS[kind], "emitter", file, kind)
    supply = board.get("supply_pin")
    if supply not in (None, SUPPLY_PIN):
        raise SceneError(
            "%s: board: the firmware measures the supply on %s, not on %s" % (file, SUPPLY_PIN, supply),
            "wire the divider to %s, or leave supply_pin out when there is none" % SUPPLY_PIN,
        )
    if "rail_volts" not in board:
        raise SceneError("%s: board: rail_volts is missing" % file, "the rail of the shunt regulator, 1.8")
    phases = tuple((phase.sense, tuple(sorted(phase.light))) for phase in headset.phases)
    if phases and phases != PHASES[kind]:
        raise SceneError(
            "%s: these are not the phases of the firmware" % file,
            "it has %s" % "; ".join(_said(headset, *phase) for phase in PHASES[kind]),
        )


def _said(headset, sense, light):
    sensing = ", ".join(headset.sensors[i].name for i in sense)
    return "%s by %s" % (sensing, ", ".join(headset.emitters[i].name for i in light))


def _check_pins(headset, file):
    """SceneError when there is no such pin, or two want the same."""
    taken = {}
    ports = {port.name: port.pin for port in headset.sensors + headset.emitters}
    for who, pin in [*ports.items(), ("supply_pin", headset.board.get("supply_pin"))]:
        if pin is None:
            continue
        if pin not in ANALOG + DIGITAL:
            raise SceneError(
                "%s: %s: a Nano has no free pin %r" % (file, who, pin), "pins are A0..A7 and D2..D13"
            )
        if pin in taken:
            raise SceneError(
                "%s: %s and %s are both on pin %s" % (file, taken[pin], who, pin), "move one of them"
            )
        taken[pin] = who


def _check_kind(headset, file, kind):
    same = [p.name for p in headset.sensors] == [p.name for p in headset.emitters]
    if kind == "leds" and not same:
        raise SceneError(
            '%s: wiring "leds" is of [[led]]s alone' % file, 'wiring = "photodiodes" has separate ones'
        )
    if kind == "photodiodes" and {p.name for p in headset.sensors} & {p.name for p in headset.emitters}:
        raise SceneError(
            '%s: wiring "photodiodes" is of [[sensor]]s and [[emitter]]s' % file,
            '[[led]]s have wiring = "leds"',
        )


def _check_order(ports, pins, what, file, kind):
    if len(ports) != len(pins):
        raise SceneError(
            '%s: wiring "%s" has %d %ss, not %d' % (file, kind, len(pins), what, len(ports)),
            "leave [board] wiring out of a headset that is only simulated",
        )
    for number, (port, pin) in enumerate(zip(ports, pins)):
        if port.pin is None:
            raise SceneError("%s: %s has no pin" % (file, port.name), 'write pin = "%s"' % pin)
        if port.pin != pin:
            raise SceneError(
                '%s: %s is on pin %s, where wiring "%s" has %s for %s %d'
                % (file, port.name, port.pin, kind, pin, what, number),
                "list %ss in the order of their pins" % what,
            )
