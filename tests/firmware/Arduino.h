/* The part of the Arduino interface that example.ino and teensy.ino use; stub.cpp and m7_board.cpp implement it. */
#pragma once
#include <stddef.h>
#include <stdint.h>

enum { LOW = 0, HIGH = 1, INPUT_PULLUP = 2, OUTPUT = 1, CHANGE = 4 };

struct StubSerial {
    void begin(unsigned long baud);
    int available();
    int availableForWrite();
    int read();
    size_t write(const uint8_t *data, size_t n);
};
extern StubSerial Serial;

void pinMode(uint8_t pin, uint8_t mode);
int digitalRead(uint8_t pin);
void digitalWrite(uint8_t pin, uint8_t level);
void analogWrite(uint8_t pin, int value);
void analogWriteResolution(int bits);
#define BOARD_WATCHDOG stub_watchdog
void stub_watchdog(uint32_t ms);
unsigned long micros();
void delay(unsigned long ms);
void noInterrupts();
void interrupts();
uint8_t digitalPinToInterrupt(uint8_t pin);
void attachInterrupt(uint8_t interrupt, void (*handler)(), int mode);
void setup();
void loop();
