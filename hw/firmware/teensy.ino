/* Runs an exported tick for two axes on a Teensy 4 without a host: quadrature encoders, PWM and direction, an enable line and
 * a dead-man switch. Put into the same folder haptic_alone.h, board_watchdog.h, and coupling-process.c from
 *
 *     python -m design.export coupling.json --process --without-theta --force-limit 8 --out coupling-process.c
 *
 * Keys over USB: h home (with the handles in the middle of their travel), a arm, s stop. Adapt the numbers below. */
#include <Arduino.h>

#include "board_watchdog.h"
#include "coupling-process.c"
#include "haptic_alone.h"

static const uint8_t AXES = PROCESS_CHANNELS;
static const uint8_t ENCODER_A[] = {2, 4}, ENCODER_B[] = {3, 5}, MOTOR_PWM[] = {9, 10}, MOTOR_DIRECTION[] = {7, 8};
static const uint8_t ENABLE = 6;   /* of both drivers; with an external pull-down: without power there is no force */
static const uint8_t DEADMAN = 12; /* closes to ground while it is held: released, unplugged and broken all read HIGH */
static const uint8_t PWM_BITS = 12;
static const double FULL_FORCE = 12.0, METRES_PER_COUNT = 10e-6; /* FULL_FORCE: [N] at full PWM */
static const int32_t CAP_MN = 8000; /* [mN] */
static const ha_limits LIMITS = {0.05, 1.0, CAP_MN / 1000.0, METRES_PER_COUNT, 0.25}; /* range, speed, cap, count, mass */
static const uint32_t PERIOD_US = PROCESS_PERIOD_NS / 1000;

static_assert(PROCESS_CHANNELS <= 2, "The sketch names pins for two axes: add pins, or export fewer axes.");
static_assert(PROCESS_FORCE_LIMIT_MN <= CAP_MN, "The sketch clips forces above CAP_MN: export with a smaller --force-limit.");
static_assert(PROCESS_PERIOD_NS % 1000 == 0, "The sketch counts whole microseconds: choose such a T.");
static ha_runner runner;
static volatile int32_t position[2];
static int32_t home[2];
static uint32_t due;

static void edge(uint8_t axis) /* one count for every edge of channel A */
{
  bool same = digitalRead(ENCODER_A[axis]) == digitalRead(ENCODER_B[axis]);
  position[axis] = position[axis] + (same ? 1 : -1);
}
static void edge0() { edge(0); }
static void edge1() { edge(1); }

static void writeForces(const double *force)
{
  for (uint8_t a = 0; a < AXES; a++) {
    double steps = (force[a] < 0 ? -force[a] : force[a]) / FULL_FORCE * ((1 << PWM_BITS) - 1);
    digitalWrite(MOTOR_DIRECTION[a], force[a] < 0 ? HIGH : LOW);
    analogWrite(MOTOR_PWM[a], (int)(steps + 0.5));
  }
  digitalWrite(ENABLE, runner.phase >= HA_TESTING ? HIGH : LOW);
}

static void report() /* sends phase and cause unless the line is busy */
{
  const uint8_t line[3] = {(uint8_t)('0' + runner.phase), (uint8_t)('0' + runner.cause), '\n'};
  if (Serial.availableForWrite() >= 3) Serial.write(line, 3);
}

void setup()
{
  for (uint8_t a = 0; a < AXES; a++) {
    pinMode(ENCODER_A[a], INPUT_PULLUP);
    pinMode(ENCODER_B[a], INPUT_PULLUP);
    pinMode(MOTOR_PWM[a], OUTPUT);
    pinMode(MOTOR_DIRECTION[a], OUTPUT);
    attachInterrupt(digitalPinToInterrupt(ENCODER_A[a]), a ? edge1 : edge0, CHANGE);
  }
  pinMode(ENABLE, OUTPUT);
  digitalWrite(ENABLE, LOW);
  pinMode(DEADMAN, INPUT_PULLUP);
  analogWriteResolution(PWM_BITS);
  Serial.begin(2000000);
  watchdogStart(20);
  due = (uint32_t)micros() + PERIOD_US;
}

void loop()
{
  uint32_t late = (uint32_t)micros() - due;
  if (late >= 0x80000000u) return; /* not due yet */
  if (late > PERIOD_US) {          /* a whole period was lost: stop, and do not catch up */
    ha_stop(&runner, HA_LATE);
    due += late;
  }
  due += PERIOD_US;
  watchdogFeed();
  writeForces(runner.force); /* the force that was computed from the last sample: theta = 1 */
  double x[PROCESS_CHANNELS];
  int key = Serial.available() > 0 ? Serial.read() : -1;
  noInterrupts();
  for (uint8_t a = 0; a < AXES; a++) {
    if (key == 'h' && runner.phase <= HA_READY) home[a] = position[a];
    x[a] = METRES_PER_COUNT * (position[a] - home[a]);
  }
  interrupts();
  if (key == 'h' && runner.phase <= HA_READY) ha_home(&runner);
  bool held = digitalRead(DEADMAN) == LOW;
  if (key == 'a' && held) ha_arm(&runner);
  if (key == 's') ha_stop(&runner, HA_ASKED);
  if (!held) ha_stop(&runner, HA_DEADMAN);
  ha_tick(&runner, &LIMITS, x);
  static uint8_t ticks;
  if (++ticks % 128 == 0) report();
}
