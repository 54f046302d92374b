# SPDX-License-Identifier: Apache-2.0
"""Flashing a virtual Nano through the stock bootloaders: by us, by avrdude, cut off, without auto-reset."""

import configparser
import subprocess
import threading

import pytest
from intelhex import IntelHex
from material import FIRMWARE, REPO, avr_build, make_image

from sparsegaze import store
from sparsegaze.device import Device
from sparsegaze.errors import DisconnectedError, FlashError, NoDeviceError, ProtocolError
from sparsegaze.flash import PARKED, flash_hex
from sparsegaze.transport import open_link
from sparsegaze.wire import ffi, lib

FOREIGN = r"""
#include <avr/io.h>
#include <util/delay.h>
int main(void)
{
    UCSR0A = 1 << U2X0;
    UBRR0 = 1;
    UCSR0B = 1 << TXEN0;
    for (;;) {
        for (const char *text = "blink blink\r\n"; *text; text++) {
            while (!(UCSR0A & (1 << UDRE0)));
            UDR0 = *text;
        }
        _delay_ms(20);
    }
}
"""


def crc(image):
    return ffi.from_buffer("struct sg_model_head *", image).crc


@pytest.mark.parametrize("bootloader, baud", [("optiboot", 115200), ("atmegaboot", 57600)])
def test_both_stock_bootloaders_are_found_by_trying_and_flashed(virtual_nano, firmware_hex, bootloader, baud):
    nano = virtual_nano(map=False, unpaced=True, bootloader=bootloader)
    report = flash_hex(nano.port, firmware_hex)
    assert report.verified and report.baud == baud
    assert report.bytes == len(IntelHex(str(firmware_hex)).addresses())
    with Device(nano.port) as device:
        assert device.hello.wire_version == lib.SG_WIRE_VERSION
        assert device.status().frames > 0


def small_build():
    """Flags of the shipped build, without which the firmware does not fit."""
    config = configparser.ConfigParser()
    config.read(REPO / "platformio.ini")
    flags = [flag for flag in config["env:nano"]["build_flags"].split("\n") if flag and flag[:2] != "-I"]
    return [*flags, "-flto", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections"]


def test_stock_avrdude_flashes_the_same_hex_and_reads_it_back(virtual_nano, firmware_hex, tmp_path):
    nano = virtual_nano(map=False)
    read = tmp_path / "read.hex"
    for work in (["-D", "-U", f"flash:w:{firmware_hex}:i"], ["-U", f"flash:r:{read}:i"]):
        # avrdude resets the board once, on opening the port: on a busy host it may then come too late.
        for turn in range(3):
            done = subprocess.run(["avrdude", "-q", "-q", "-p", "m328p", "-c", "arduino", "-P", nano.port,
                                   "-b", "115200", *work], capture_output=True, text=True)
            if done.returncode == 0:
                break
        assert done.returncode == 0, done.stderr
    sent, found = IntelHex(str(firmware_hex)), IntelHex(str(read))
    assert all(sent[address] == found[address] for address in sent.addresses())
    with Device(nano.port) as device:
        assert device.hello.board == lib.SG_BOARD_NANO328P


def test_stored_models_and_live_state_survive_a_flash_and_a_power_cycle(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
    reports = [store.upload(nano.port, make_image(seed)) for seed in (1, 2)]
    with Device(nano.port) as device:
        device.recentre(offset_deg=(1.25, -0.5))
        device.link.sleep(0.5)                  # the EEPROM takes 3.4 ms a byte
    assert flash_hex(nano.port).verified
    for _ in range(2):
        with Device(nano.port) as device:
            info = device.model_info()
            assert (info.crc[0], info.crc[1], info.active) == (reports[0].crc, reports[1].crc, 1)
            assert device.read_model() == store.stamp(make_image(2), 2)
            assert device.verify(1).crc == reports[1].crc
            assert (device.recentre().azimuth_deg, device.recentre().elevation_deg) == (1.25, -0.5)
        nano.control.power(False)
        nano.control.power(True)


def test_killed_during_any_phase_of_a_flash_leaves_a_parked_board_that_can_be_flashed_again(
        virtual_nano, firmware_hex, tmp_path):
    state = tmp_path / "state"
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex, state_dir=state)
    stored = store.upload(nano.port, make_image(3))
    nano.stop()
    for stage, done in (("write", 1), ("write", 90), ("verify", 60)):
        nano = virtual_nano(map=False, unpaced=True, state_dir=state)

        def pull(now_stage, now_done, total):
            if (now_stage, now_done) == (stage, done):
                nano.control.power(False)       # what is in flash goes to its file
                nano.kill()
        with pytest.raises(DisconnectedError) as caught:
            flash_hex(nano.port, firmware_hex, pull)
        assert "not finished" in caught.value.message and "starts afresh" in caught.value.remedy
        nano.stop()
        assert (state / "flash.bin").read_bytes()[:128] == PARKED
    nano = virtual_nano(map=False, unpaced=True, state_dir=state)
    with pytest.raises(NoDeviceError, match="nothing answers"):
        Device(nano.port)
    assert flash_hex(nano.port, firmware_hex).verified
    with Device(nano.port) as device:
        assert device.model_info().crc[0] == stored.crc


def test_a_board_with_its_reset_trace_cut_is_flashed_when_the_button_is_pressed(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, auto_reset=False, app=firmware_hex)
    asked = []

    def progress(stage, done, total):
        if stage == "press reset":
            asked.append(done)
            if len(asked) == 3:
                nano.control.reset()

    assert flash_hex(nano.port, firmware_hex, progress).verified
    assert len(asked) == 3


def test_a_board_with_its_reset_trace_cut_and_no_finger_says_what_to_do(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, auto_reset=False, app=firmware_hex)
    with pytest.raises(FlashError, match="press the board's reset button"):
        flash_hex(nano.port, firmware_hex)
    with Device(nano.port) as device:           # the running firmware is still there
        assert device.status().frames > 1000


def test_foreign_firmware_on_the_chip_is_recognised_and_replaced(virtual_nano, firmware_hex, tmp_path):
    source = tmp_path / "blink.c"
    source.write_text(FOREIGN)
    nano = virtual_nano(map=False, unpaced=True)
    flash_hex(nano.port, avr_build(tmp_path, [source]))
    with pytest.raises(NoDeviceError) as caught:
        Device(nano.port)
    assert "blink" in caught.value.message and f"sparsegaze flash {nano.port}" in caught.value.remedy
    flash_hex(nano.port, firmware_hex)
    with Device(nano.port) as device:
        assert device.hello.channels == 6


def test_firmware_of_another_protocol_version_is_named_and_replaced(virtual_nano, firmware_hex, tmp_path):
    core = tmp_path / "core"
    core.mkdir()
    for path in (FIRMWARE / "core").iterdir():
        if path.suffix in (".c", ".h", ".S") and not path.name.startswith("sg_mlp"):    # as platformio.ini
            (core / path.name).write_text(path.read_text())
    header = (core / "sg_wire.h").read_text()
    old, new = f"SG_WIRE_VERSION = {lib.SG_WIRE_VERSION}", f"SG_WIRE_VERSION = {lib.SG_WIRE_VERSION + 2}"
    assert header.count(old) == 1
    (core / "sg_wire.h").write_text(header.replace(old, new))
    (core / "sg_gp_loop.c").unlink()            # its twin in assembler takes its place
    sources = [path for folder in (core, FIRMWARE / "app", FIRMWARE / "ports" / "avr328p")
               for path in sorted(folder.iterdir()) if path.suffix in (".c", ".S")]
    flags = [f"-I{core}", f"-I{FIRMWARE / 'app'}", f"-I{FIRMWARE / 'ports' / 'avr328p'}", *small_build()]
    nano = virtual_nano(map=False, unpaced=True)
    flash_hex(nano.port, avr_build(tmp_path, sources, flags))
    with pytest.raises(ProtocolError) as caught:
        Device(nano.port)
    assert f"device speaks protocol {lib.SG_WIRE_VERSION + 2} (firmware " in caught.value.message
    flash_hex(nano.port, firmware_hex)
    with Device(nano.port) as device:
        assert device.hello.wire_version == lib.SG_WIRE_VERSION


def test_a_port_in_use_is_not_reset_under_its_user(virtual_nano, firmware_hex):
    from sparsegaze.errors import PortError

    nano = virtual_nano(map=False, app=firmware_hex)
    with Device(nano.port) as device:
        with pytest.raises(PortError, match="in use"):
            flash_hex(nano.port, firmware_hex)
        assert device.ping().rx_us > 0


def test_real_time_port_disappears_while_it_is_read(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, app=firmware_hex)
    with Device(nano.port) as device:
        device.set_stream(raw=True, gaze=True)
        timer = threading.Timer(0.3, nano.kill)
        timer.start()
        with pytest.raises(DisconnectedError):
            for _ in device.frames():
                pass
        timer.join()
    with pytest.raises(Exception) as caught:
        open_link(nano.port)
    assert "no such port" in str(caught.value)


def test_the_packaged_hex_is_the_default(virtual_nano):
    assert (REPO / "host_sdk" / "sparsegaze" / "data" / "firmware.hex").is_file()
    nano = virtual_nano(map=False, unpaced=True)
    assert flash_hex(nano.port).verified
