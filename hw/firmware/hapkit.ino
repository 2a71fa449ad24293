/* Runs an exported tick on a Hapkit-like device (ATmega328P at 16 MHz, one axis) without a host: an analog magnetic sensor
 * that wraps twice per motor turn, a capstan, PWM and direction, 115200 baud. Put into the same folder haptic_alone.h,
 * board_watchdog.h, and coupling-process.c from
 *
 *     python -m design.export coupling.json --process --without-theta --float --force-limit 4.8 --out coupling-process.c
 *
 * Keys over the serial line: h home (hold the handle against the stop at HOME), a arm, s stop. Forces act only while the
 * dead-man switch is held. The numbers below are those of one device: measure yours. */
#include <Arduino.h>

#include "board_watchdog.h"
#define HA_REAL float
#include "coupling-process.c"
#include "haptic_alone.h"

static const uint8_t SENSOR = A2, PWM = 5, DIRECTION = 8, DEADMAN = 12; /* the switch closes to ground while it is held */
static const int16_t SPAN = 1024; /* counts from wrap to wrap, half a turn of the motor */
/* [m/rad] path of the handle per motor angle: handle radius times the capstan's ratio, motor radius over sector radius */
static const float METRES_PER_RADIAN = 0.09f * 0.005f / 0.073f;
static const float METRES_PER_COUNT = METRES_PER_RADIAN * 3.14159265f / SPAN;
static const float FULL_TORQUE = 0.03f; /* [N m] of the motor at full PWM: 4.9 N at the handle */
static const float HOME = -0.045f;      /* [m] position of the handle when it is homed */
static const int32_t CAP_MN = 4800;     /* [mN] */
static const ha_limits LIMITS = {0.05f, 1.0f, CAP_MN / 1000.0f, METRES_PER_COUNT, 0.07f}; /* range, speed, cap, count, mass */
static const int32_t COUNT_NS = 8000 / (F_CPU / 1000000); /* timer 1 counts every 8 cycles */
static const uint16_t PERIOD_COUNTS = (uint16_t)(PROCESS_PERIOD_NS / COUNT_NS);

static_assert(PROCESS_CHANNELS == 1, "The Hapkit has one axis: export a scenario with one axis.");
static_assert(PROCESS_FORCE_LIMIT_MN <= CAP_MN, "The sketch clips forces above CAP_MN: export with a smaller --force-limit.");
static_assert(PROCESS_PERIOD_NS % COUNT_NS == 0, "Timer 1 cannot count this T: choose a multiple of 0.5 us.");

static ha_runner runner;
static int16_t last;
static int32_t wrapped, home_counts;
static uint16_t longest, ticks; /* longest: the longest tick since the last report, in counts of timer 1 */

#ifndef MARK
#define MARK(what) /* the tests count cycles between marks */
#endif

/* Returns the counts of the motor without wraps. The motor must turn by less than a quarter turn between two ticks. */
static int32_t readSensor()
{
  int16_t raw = (int16_t)analogRead(SENSOR);
  if (raw - last > SPAN / 2) wrapped -= SPAN;
  if (last - raw > SPAN / 2) wrapped += SPAN;
  last = raw;
  return wrapped + raw;
}

/* Sets a force at the handle [N], positive towards positive x. */
static void writeForce(float force)
{
  float size = (force < 0 ? -force : force) * (255.0f * METRES_PER_RADIAN / FULL_TORQUE) + 0.5f;
  digitalWrite(DIRECTION, force < 0 ? HIGH : LOW);
  OCR0B = size > 255.0f ? 255 : (uint8_t)size; /* pin 5 */
}

/* Sends phase, cause, position [10 um] and longest tick [us]. Printing takes 0.5 ms of this processor, so nothing is printed
 * while the coupling runs or the line is busy. */
static void report()
{
  if (runner.phase >= HA_RUNNING || Serial.availableForWrite() < 40) return;
  Serial.print((char)('0' + runner.phase));
  Serial.print((char)('0' + runner.cause));
  Serial.print(' ');
  Serial.print((int)(1e5f * runner.before[0]));
  Serial.print(' ');
  Serial.println(longest / 2);
  longest = 0;
}

void setup()
{
  pinMode(PWM, OUTPUT);
  pinMode(DIRECTION, OUTPUT);
  pinMode(DEADMAN, INPUT_PULLUP);
  Serial.begin(115200);
  TIMSK0 = 0;                                         /* no interrupts of timer 0: millis() stands still */
  TCCR0A = _BV(COM0B1) | _BV(WGM01) | _BV(WGM00);     /* fast PWM on pin 5 */
  TCCR0B = _BV(CS00);                                 /* at 62.5 kHz */
  OCR0B = 0;
  TCCR1A = 0;                                         /* timer 1 counts the period in units of 8 cycles */
  TCCR1B = _BV(WGM12) | _BV(CS11);
  OCR1A = PERIOD_COUNTS - 1;
  last = (int16_t)analogRead(SENSOR);
  watchdogStart(30);
  TIFR1 = _BV(OCF1A);
}

void loop()
{
  if (!(TIFR1 & _BV(OCF1A))) return; /* not due yet */
  TIFR1 = _BV(OCF1A);
  MARK(1);
  watchdogFeed();
  writeForce(runner.force[0]); /* the force that was computed from the last sample: theta = 1 */
  int32_t counts = readSensor();
  float x = METRES_PER_COUNT * (float)(counts - home_counts) + HOME;
  int key = Serial.read();
  if (key == 'h' && runner.phase <= HA_READY) {
    home_counts = counts;
    ha_home(&runner);
    x = runner.before[0] = runner.older[0] = HOME;
  }
  bool held = digitalRead(DEADMAN) == LOW;
  if (key == 'a' && held) ha_arm(&runner);
  if (key == 's') ha_stop(&runner, HA_ASKED);
  if (!held) ha_stop(&runner, HA_DEADMAN);
  MARK(2);
  ha_tick(&runner, &LIMITS, &x);
  MARK(3);
  if (++ticks % 128 == 0) report();
  if (TIFR1 & _BV(OCF1A)) { /* the next period has begun: this tick was too long */
    ha_stop(&runner, HA_LATE);
    TIFR1 = _BV(OCF1A);
  }
  uint16_t took = TCNT1;
  if (took > longest) longest = took;
  MARK(4);
}
