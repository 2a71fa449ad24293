/* The parts of an Arduino board that example.ino needs, driven by a test: pins, a clock and a serial port in memory. */
#include <Arduino.h>

#include <deque>
#include <vector>

static std::deque<uint8_t> incoming;
static std::vector<uint8_t> outgoing;
static int pins[64], room = 1 << 20;
static unsigned long clock_us;
static void (*handlers[64])();
static int resolution = 8;
static uint32_t watchdog_ms;
static unsigned long fed_us;

StubSerial Serial;
void StubSerial::begin(unsigned long) {}
int StubSerial::available() { return (int)incoming.size(); }
int StubSerial::availableForWrite() { return room; }
int StubSerial::read()
{
    int byte = incoming.front();
    incoming.pop_front();
    return byte;
}
size_t StubSerial::write(const uint8_t *data, size_t n)
{
    outgoing.insert(outgoing.end(), data, data + n);
    return n;
}

void pinMode(uint8_t, uint8_t) {}
int digitalRead(uint8_t pin) { return pins[pin]; }
void digitalWrite(uint8_t pin, uint8_t level) { pins[pin] = level; }
void analogWrite(uint8_t pin, int value) { pins[pin] = value; }
void analogWriteResolution(int bits) { resolution = bits; }
void stub_watchdog(uint32_t ms)
{
    if (ms) watchdog_ms = ms;
    fed_us = clock_us;
}
unsigned long micros() { return clock_us; }
void delay(unsigned long) {}
void noInterrupts() {}
void interrupts() {}
uint8_t digitalPinToInterrupt(uint8_t pin) { return pin; }
void attachInterrupt(uint8_t pin, void (*handler)(), int) { handlers[pin] = handler; }

extern "C" {
int stub_resolution() { return resolution; }
int stub_bites() { return watchdog_ms && clock_us - fed_us > 1000 * watchdog_ms; }
void stub_setup() { setup(); }
void stub_loop(unsigned long now)
{
    clock_us = now;
    loop();
}
void stub_feed(const uint8_t *data, size_t n) { incoming.insert(incoming.end(), data, data + n); }
void stub_room(int bytes) { room = bytes; }
int stub_pin(int pin) { return pins[pin]; }
void stub_set_pin(int pin, int level)
{
    bool edge = pins[pin] != level;
    pins[pin] = level;
    if (edge && handlers[pin]) handlers[pin]();
}
size_t stub_sent(uint8_t *out, size_t room_for)
{
    size_t n = outgoing.size() < room_for ? outgoing.size() : room_for;
    for (size_t i = 0; i < n; i++) out[i] = outgoing[i];
    outgoing.erase(outgoing.begin(), outgoing.begin() + (long)n);
    return n;
}
}
