// SPDX-License-Identifier: Apache-2.0
// EEPROM and self-programming on the bench. Commands:
//   'E' address16, value, mode   write a byte with EEPM = mode; answers cycles / 16 until EEPE falls, 16 bits
//   'B' address16, value         begin a write and say 'b' at once
//   'R' address16                read a byte
//   'I' address16, value         write, then count ready interrupts in 1 ms while it is busy and in 1 ms
//   after 'M' address16, value         write without EEMPE in time: the byte afterwards
//   'P' address16, word16        SPM: fill one word of the buffer, write the page (no erase); busy and RWWSB
//   flags seen 'X' address16                SPM: erase a page
//   'F' address16                read flash
//   'G' address16                read flash while a page erase of 0x5000 runs, then after RWWSRE
#include "bench.h"

#include <avr/boot.h>
#include <avr/pgmspace.h>

static volatile uint16_t ready;

ISR(EE_READY_vect)
{
    ready++;
    if (ready >= 1000)
        EECR &= (uint8_t)~_BV(EERIE);
}

static uint16_t get16(void)
{
    uint8_t low = bench_get();
    return (uint16_t)(low | bench_get() << 8);
}

static void begin(uint16_t address, uint8_t value, uint8_t mode)
{
    EEAR = address;
    EEDR = value;
    EECR = (uint8_t)(mode << EEPM0);
    __asm__ volatile("sbi %0, %1\n\tsbi %0, %2" : : "I"(_SFR_IO_ADDR(EECR)), "I"(EEMPE), "I"(EEPE));
}

static uint8_t eeprom(uint16_t address)
{
    EEAR = address;
    EECR |= _BV(EERE);
    return EEDR;
}

static void timed_write(void)
{
    uint16_t address = get16();
    uint8_t value = bench_get(), mode = bench_get();
    TCCR1B = 0;
    TCNT1 = 0;
    begin(address, value, mode);
    TCCR1B = _BV(CS11);         // cycles / 8
    while (EECR & _BV(EEPE))
        ;
    bench_put16(TCNT1);
}

static void count_ready(void)
{
    uint16_t address = get16();
    uint8_t value = bench_get();
    ready = 0;
    begin(address, value, 0);
    EECR |= _BV(EERIE);
    sei();
    __builtin_avr_delay_cycles(16000);
    bench_put16(ready);
    __builtin_avr_delay_cycles(60000);
    cli();
    EECR &= (uint8_t)~_BV(EERIE);
    bench_put(ready > 100);
}

static void too_late(void)
{
    EEAR = get16();
    EEDR = bench_get();
    __asm__ volatile("sbi %0, %1\n\tnop\n\tnop\n\tnop\n\tnop\n\tsbi %0, %2"
                     : : "I"(_SFR_IO_ADDR(EECR)), "I"(EEMPE), "I"(EEPE));
    bench_put(EECR & _BV(EEPE));
}

static void program(void)
{
    uint16_t address = get16(), word = get16();
    boot_page_fill(address, word);
    boot_page_write(address);
    bench_put(SPMCSR & (_BV(RWWSB) | _BV(SELFPRGEN)));
    boot_spm_busy_wait();
    bench_put(SPMCSR & (_BV(RWWSB) | _BV(SELFPRGEN)));
    boot_rww_enable();
    bench_put(SPMCSR & (_BV(RWWSB) | _BV(SELFPRGEN)));
}

static void erase(void)
{
    uint16_t address = get16();
    TCCR1B = 0;
    TCNT1 = 0;
    boot_page_erase(address);
    TCCR1B = _BV(CS11);
    boot_spm_busy_wait();
    bench_put16(TCNT1);
    boot_rww_enable();
}

static void read_while_busy(void)
{
    uint16_t address = get16();
    boot_page_erase(0x5000);
    bench_put(pgm_read_byte(address));
    boot_spm_busy_wait();
    bench_put(pgm_read_byte(address));
    boot_rww_enable();
    bench_put(pgm_read_byte(address));
}

int main(void)
{
    bench_begin();
    for (;;)
        switch (bench_get()) {
        case 'E': timed_write(); break;
        case 'B': {
            uint16_t address = get16();
            begin(address, bench_get(), 0);
            bench_put('b');
            break;
        }
        case 'R': bench_put(eeprom(get16())); break;
        case 'I': count_ready(); break;
        case 'M': too_late(); break;
        case 'P': program(); break;
        case 'X': erase(); break;
        case 'F': bench_put(pgm_read_byte(get16())); break;
        case 'G': read_while_busy(); break;
        }
}
