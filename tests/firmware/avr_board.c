/* Runs a sketch on a simulated ATmega328P: avr_board FILE.elf [TICKS]. Without TICKS it ends when the sketch stops the processor
 * and returns GPIOR0. Otherwise every line of standard input orders one tick, "MILLIVOLTS KEY SWITCH", and every line of standard
 * output reports one: cycles of ha_tick, cycles from the start of the period to the end of the tick, PWM, direction. The sketch
 * marks its progress by writing 1 to 4 to GPIOR0. The sketch's serial output goes to standard error. */
#include <simavr/avr_adc.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>

enum { GPIOR0 = 0x3e, OCR0B = 0x48, PORTB = 0x25 };
static avr_cycle_count_t at[5];
static int ended;

static void mark(struct avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    (void)param;
    avr->data[addr] = value;
    if (value < 5) at[value] = avr->cycle;
    ended |= value == 4;
}
static void sent(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq, (void)param;
    fputc((int)value, stderr);
}

int main(int argc, char **argv)
{
    elf_firmware_t firmware = {0};
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    uint32_t flags = 0;
    avr_ioport_external_t switch_12 = {.name = 'B', .mask = 16, .value = 16};
    int millivolts, held, state = cpu_Running;
    char key;
    if (argc < 2 || !avr || elf_read_firmware(argv[1], &firmware)) return 100;
    avr_init(avr);
    avr_load_firmware(avr, &firmware);
    avr->frequency = 16000000;
    avr->avcc = avr->vcc = avr->aref = 5000;
    avr_register_io_write(avr, GPIOR0, mark, NULL);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), sent, NULL);
    while (argc == 2 && state != cpu_Done && state != cpu_Crashed && !(state == cpu_Sleeping && !avr->sreg[S_I]))
        state = avr_run(avr);
    while (argc > 2 && scanf("%d %c %d", &millivolts, &key, &held) == 3) {
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, 2), (uint32_t)millivolts);
        switch_12.value = held ? 0 : 16;
        avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('B'), &switch_12);
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 4), !held);
        if (key != '.') avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), (uint32_t)key);
        for (ended = 0; !ended;)
            if ((state = avr_run(avr)) == cpu_Done || state == cpu_Crashed) return 101;
        printf("%d %d %d %d\n", (int)(at[3] - at[2]), (int)(at[4] - at[1]), avr->data[OCR0B], avr->data[PORTB] & 1);
        fflush(stdout);
    }
    return argc > 2 ? 0 : avr->data[GPIOR0];
}
