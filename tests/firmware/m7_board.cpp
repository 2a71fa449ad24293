/* A board with a Cortex-M7 for qemu's mps2-an500: start-up code, and what teensy.ino needs of an Arduino board.
 *
 * Every line of standard input (by semihosting) orders one period, "COUNTS1 COUNTS2 KEY SWITCH"; every line of standard output
 * reports it: PWM and direction of both axes, the enable line, and what the sketch has sent. Compiled with VECTOR, it runs the
 * exported file's own test instead. */
#include <stdio.h>

extern "C" void _start(void);
extern "C" [[noreturn]] void reset(void)
{
    *(volatile unsigned *)0xE000ED88u |= 0xFu << 20; /* CPACR: the floating-point unit */
    __asm volatile("dsb\nisb");
    _start();
    for (;;) {}
}
extern "C" [[noreturn]] void fault(void)
{
    for (;;) {}
}
__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))0x20200000, reset, fault, fault, fault, fault, fault};

#ifdef VECTOR
#define HAPTIC_LOOP_TEST
#include "coupling-process.c"
#else
#include "Arduino.h"

static int pins[64], key = -1, counts[2];
static unsigned long now;
static void (*handlers[64])();
static char sent[8] = "-";
StubSerial Serial;

void StubSerial::begin(unsigned long) {}
int StubSerial::available() { return key >= 0; }
int StubSerial::availableForWrite() { return 64; }
int StubSerial::read()
{
    int byte = key;
    key = -1;
    return byte;
}
size_t StubSerial::write(const uint8_t *data, size_t n)
{
    for (size_t i = 0; i + 1 < n && i < sizeof sent - 1; i++) sent[i] = (char)data[i];
    return n;
}
void pinMode(uint8_t, uint8_t) {}
int digitalRead(uint8_t pin) { return pins[pin]; }
void digitalWrite(uint8_t pin, uint8_t level) { pins[pin] = level; }
void analogWrite(uint8_t pin, int value) { pins[pin] = value; }
void analogWriteResolution(int) {}
void stub_watchdog(uint32_t) {}
unsigned long micros() { return now; }
void noInterrupts() {}
void interrupts() {}
uint8_t digitalPinToInterrupt(uint8_t pin) { return pin; }
void attachInterrupt(uint8_t pin, void (*handler)(), int) { handlers[pin] = handler; }

/* Each edge of channel A changes the sketch's count by one: up if both channels are equal after the edge, else down. */
static void move(int axis, int target)
{
    int a = axis ? 4 : 2, b = a + 1;
    for (; counts[axis] != target; counts[axis] += counts[axis] < target ? 1 : -1) {
        pins[a] = !pins[a];
        pins[b] = counts[axis] < target ? pins[a] : !pins[a];
        handlers[a]();
    }
}

int main()
{
    int first, second, held;
    char typed;
    setup();
    while (scanf("%d %d %c %d", &first, &second, &typed, &held) == 4) {
        move(0, first);
        move(1, second);
        key = typed == '.' ? -1 : typed;
        pins[12] = !held;
        for (unsigned long end = now + STUB_PERIOD_US; now < end;) {
            now += 50;
            loop();
        }
        printf("%d %d %d %d %d %s\n", pins[9], pins[7], pins[10], pins[8], pins[6], sent);
        fflush(stdout);
    }
    return 0;
}
#endif
