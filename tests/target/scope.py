# SPDX-License-Identifier: Apache-2.0
"""An oscilloscope for the virtual Nano in lockstep: stops its clock and reads off when each LED last changed.

The virtual Nano keeps, per LED, how it is driven and the exact cycle of its last event (a change of drive, or
a sample taken); so single microseconds of stepping are enough for exact cycles.
"""

from collections import namedtuple

LEDS = 6
CYCLES_PER_US = 16
SLOT_US = 640
OFF, EMIT, REVERSE, PULLUP, FLOAT, OPEN = range(6)      # how a LED is driven

# since: cycle of the last event; held: volts on the ADC's sample capacitor
Node = namedtuple("Node", "drive since held")
Slot = namedtuple("Slot", "led lit release sample dark")    # cycles


class Scope:
    """Looks at `nano` while its clock is moved by `link` only."""

    def __init__(self, nano, link):
        self._control = nano.control
        self._link = link

    def node(self, led):
        """Node: how the LED is driven, and since which cycle."""
        _, drive, since, held = self._control.command(f"node {led}").split()
        return Node(int(drive), int(since), held)

    def step(self, us):
        self._link.sleep(us * 1e-6)

    def run_to(self, cycle, before_us):
        """Run to some microseconds before a cycle; not at all when that has passed."""
        us = cycle // CYCLES_PER_US - before_us - round(self._link.now() * 1e6)
        if us > 0:
            self.step(us)

    def sampled(self, led, before):
        """Cycle of the sample taken since the Node `before`, or None: a sample changes what the ADC holds."""
        now = self.node(led)
        return now.since if now.held != before.held else None

    def until(self, condition, step_us=1, limit_us=2 * SLOT_US):
        """Step until condition() is true; its value."""
        for _ in range(int(limit_us / step_us)):
            found = condition()
            if found:
                return found
            self.step(step_us)
        raise AssertionError(f"nothing seen for {limit_us} us")

    def slots(self, n, exposure_us, between=lambda: None, skip_us=SLOT_US - 30):
        """The next n slots, one after the other.

        exposure_us   what each LED's exposure should be, us: looked at closely from 8 us before its end
        between       called in every slot while nothing is to be seen
        skip_us       from one light to where looking for the next begins; less when slots may be late
        Asserts the order of events, and that it is the five other LEDs that emit.
        """
        found = []
        led = self.until(lambda: next((str(i) for i in range(LEDS) if self.node(i).drive == FLOAT), None), 20)
        led = int(led)
        self.until(lambda: self.node(led).drive != FLOAT, 4)
        while len(found) < n:
            led = (led + 1) % LEDS
            others = [(led + k) % LEDS for k in range(1, LEDS)]
            witness = others[1]         # not the next one, which is charged as soon as the lights are out
            floating = self.until(lambda: self.node(led) if self.node(led).drive == FLOAT else None, 2)
            release = floating.since
            assert [self.node(i).drive for i in others] == [EMIT] * 5
            lit = self.node(witness).since
            between()
            self.run_to(release + int(exposure_us[led] * CYCLES_PER_US), 8)
            sample = self.until(lambda: self.sampled(led, floating))
            assert self.node(led).drive == FLOAT
            dark = self.until(lambda: self.node(witness).since if self.node(witness).drive == OFF else None)
            assert all(self.node(i).drive != EMIT for i in range(LEDS))
            found.append(Slot(led, lit, release, sample, dark))
            self.run_to(lit + skip_us * CYCLES_PER_US, 0)
        return found
