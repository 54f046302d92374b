# SPDX-License-Identifier: Apache-2.0
"""What a headset draws from its 5 V supply, from the same timing as eye safety.

    for budget in budgets(load_headset("headsets/led2gaze.toml")):
        print(budget.setting, budget.total_mw)

Counted is what the circuit needs: microcontroller, emitters by the time that they are lit, the rail's shunt
regulator and the divider that watches the supply. What an Arduino Nano adds on its board (USB chip, power
LED) is said apart. Beside it what the paper states: 800 mW for its LED headset at 250 Hz, and 16 mW,
emitters and analog front end alone, for its photodiode headset.
"""

from dataclasses import asdict, dataclass

from .eyesafety import SUPPLY_V, currents_ma
from .timing import CPU_HZ, Timing

# ATmega328P at 16 MHz and 5 V, typical supply current: data sheet DS40002061, figures "Active Supply
# Current vs. Frequency (1-20 MHz)" and "Idle Supply Current vs. Frequency (1-20 MHz)".
ACTIVE_MA, IDLE_MA = 9.2, 2.7
CONVERTER_MA = 0.3  # ADC and its reference, the same data sheet
RAIL_FEED_OHM = 330.0  # 5 V to the shunt regulator: what it takes to regulate with no emitter lit
DIVIDER_OHM = 250e3  # 240k and 10k at the supply pin
BOARD_MA = 20.0  # of a Nano: USB serial chip 15 mA, power LED 5 mA; by their data sheets, typical
# Awake in a frame of one sensing cycle, with a model of 30 vectors and the gaze stream: measured on the
# virtual Nano, 26,400 cycles at 250 Hz and 33,200 at 60 Hz (in the pauses interrupts go on). A test
# measures it again.
AWAKE_CYCLES = 30_000

PAPER_LED_MW, PAPER_PHOTODIODE_MW = 800.0, 16.0


@dataclass(frozen=True)
class Budget:
    """Mean power of one setting, mW at 5 V.

    setting     in words                    rate_hz   frames a second
    lit         emitters lit on average, counted in whole emitters
    emitter_mw, mcu_mw, rail_mw             rail: shunt regulator and divider
    board_mw    what an Arduino Nano draws besides, not in total_mw
    """

    setting: str
    rate_hz: float
    lit: float
    emitter_mw: float
    mcu_mw: float
    rail_mw: float
    board_mw: float = BOARD_MA * SUPPLY_V

    @property
    def total_mw(self):
        return self.emitter_mw + self.mcu_mw + self.rail_mw

    @property
    def front_end_mw(self):
        """What the paper's 16 mW count: emitters and the analog front end, no microcontroller."""
        return self.emitter_mw + self.rail_mw

    def report(self):
        """Plain values for JSON."""
        return dict(asdict(self), total_mw=self.total_mw, front_end_mw=self.front_end_mw)


def settings():
    """(name, Timing, whether it sleeps) of the settings that a budget is given for.

    In normal power a slower frame is the mean of more cycles, without a pause: it draws no less.
    """
    yield "default", Timing(), False
    yield "250 Hz, 4 cycles", Timing(repeats=4), False
    yield "250 Hz, low power", Timing(frame_cycles=CPU_HZ // 250), True
    yield "60 Hz, low power", Timing(frame_cycles=CPU_HZ // 60), True


def budget(headset, name, timing, sleeps):
    """The Budget of a headset that senses as `timing`; sleeps: the microcontroller idles without work."""
    duty, current = timing.emitter_duty(headset), currents_ma(headset)
    awake = min(AWAKE_CYCLES * timing.repeats / timing.frame_period_cycles, 1.0) if sleeps else 1.0
    mcu_ma = awake * ACTIVE_MA + (1 - awake) * IDLE_MA + CONVERTER_MA
    rail_ma = 0.0
    if headset.board.get("wiring") is not None:
        rail_ma += (SUPPLY_V - headset.board["rail_volts"]) / RAIL_FEED_OHM * 1e3
    if headset.board.get("supply_pin"):
        rail_ma += SUPPLY_V / DIVIDER_OHM * 1e3
    return Budget(
        name,
        timing.rate_hz,
        float(duty.sum()),
        float((duty * current).sum() * SUPPLY_V),
        mcu_ma * SUPPLY_V,
        rail_ma * SUPPLY_V,
    )


def budgets(headset):
    """A Budget for each of settings()."""
    return [budget(headset, *setting) for setting in settings()]
