# SPDX-License-Identifier: Apache-2.0
"""Starts, restarts and their causes, and the live state that outlives them."""

import pytest

from sparsegaze import wire
from sparsegaze.wire import lib


def power_cycle(nano, device):
    nano.control.power(False)
    nano.control.power(True)
    device.connect()


def test_reset_cause_is_told_apart_under_optiboot_4(board):
    nano, device = board()
    assert device.status().reset_cause == lib.SG_RESET_EXTERNAL     # opening the port reset it
    device.reboot()
    assert device.status().reset_cause == lib.SG_RESET_WATCHDOG
    power_cycle(nano, device)
    assert device.status().reset_cause == lib.SG_RESET_POWER
    device.link.reset()
    device.connect()
    assert device.status().reset_cause == lib.SG_RESET_EXTERNAL


def test_older_bootloader_starts_and_restarts_the_firmware(board):
    nano, device = board(bootloader="atmegaboot")
    assert device.status().reset_cause & lib.SG_RESET_EXTERNAL
    boots = device.status().boot_count
    device.reboot()                 # not by the watchdog, which this bootloader would never switch off
    status = device.status()
    assert status.reset_cause == lib.SG_RESET_WATCHDOG and status.boot_count == boots + 1
    device.link.sleep(0.2)
    assert device.status().frames > status.frames and nano.control.counters()["wdt_resets"] == 0


def test_bytes_that_come_while_it_starts_are_not_counted_lost(board):
    """The receiver is off until somebody takes its bytes: what came before is lost, a half packet at most."""
    nano, device = board(auto_reset=False)
    link = device.link
    for phase in range(12):
        nano.control.reset()
        link.sleep(1e-4 * phase)
        decoder, found, patience, seq = wire.Decoder(), [], link.now() + 3.0, 0
        while not found and link.now() < patience:
            seq += 1
            link.write(b"\0" + wire.encode(lib.SG_MSG_STATUS, seq))
            found = [wire.parse(wire.Status, packet.body) for packet in decoder.feed(link.read(4096, 0.0006))
                     if packet.type == lib.SG_MSG_STATUS | lib.SG_REPLY]
        assert found and found[0].rx_overrun == 0 and found[0].rx_bad <= 1
        assert 100 < found[0].stack_free < 1000         # known before the first frame


def test_boots_are_counted_through_power_cycles(board):
    nano, device = board()
    first = device.status().boot_count
    for boots in (1, 2):
        device.link.sleep(0.5)      # the count is written in the background
        power_cycle(nano, device)
        assert device.status().boot_count == first + boots
    device.link.sleep(0.5)
    assert device.status().eeprom_writes == 1


def test_exposures_start_from_the_stored_ones(board):
    nano, device = board()
    device.exposure(us=[40, 50, 60, 70, 80, 90])
    device.link.sleep(3.0)          # stored when it has rested for two seconds
    power_cycle(nano, device)
    assert device.exposure().exposure_us == (40, 50, 60, 70, 80, 90) and not device.exposure().automatic


def test_automatic_exposures_are_stored_once_they_rest_and_are_the_next_start(board):
    nano, device = board()
    device.link.sleep(5)
    settled, before = device.exposure(), device.status()
    assert settled.automatic and before.exposure_changes > 0 and before.eeprom_writes == 1
    device.link.sleep(35)
    assert device.status().eeprom_writes == 2
    power_cycle(nano, device)
    after = device.status()
    # The person moved meanwhile: an exposure near the middle of its window may be corrected once.
    assert device.exposure().exposure_us == pytest.approx(settled.exposure_us, rel=0.12)
    assert after.exposure_changes < before.exposure_changes


@pytest.mark.parametrize("damage", [b"\xff" * 72, b"\0" * 72, bytes(range(72))],
                         ids=["erased", "zeros", "ramp"])
def test_damaged_live_state_is_replaced_by_the_defaults(board, tmp_path, damage):
    state = tmp_path / "state"
    state.mkdir()
    (state / "eeprom.bin").write_bytes(damage + b"\xff" * (1024 - len(damage)))
    _, device = board(state_dir=state)
    status = device.status()
    assert status.boot_count in (1, 2) and status.exposure_auto == 1    # power-on, then the opening's reset
