/* A two-axis device on the serial link: quadrature encoders, PWM and direction to two motor drivers, an enable line and
 * an emergency stop. Put haptic_link.h, haptic_frame.h and board_watchdog.h into the same folder.
 *
 * The sketch is written for Teensy 4, whose Serial is native USB. On another board check:
 *   1. Serial is the port that you plug in (some boards call their native USB SerialUSB).
 *   2. Serial.availableForWrite() exists and returns more than 0 on an idle line. If it returns 0, nothing is ever sent.
 *   3. Serial.availableForWrite() returns at least 100 on an idle line. Two axes send an INFO of 68 bytes and STATEs of 32
 *      bytes. With less room they wait in `queue`, which delays a STATE. The host measures this delay in the round trip.
 *
 * Adapt the pins, the numbers of INFO in setup() (measure them; docs/protocol.md has their units) and the functions below. The
 * safety states are in haptic_link.h: do not change that file. */
#include <Arduino.h>

#include "board_watchdog.h"
#include "haptic_link.h"

static const uint8_t AXES = 2;
static const uint32_t PERIOD_US = 1200;
static const uint8_t ENCODER_A[AXES] = {2, 4}, ENCODER_B[AXES] = {3, 5};
static const uint8_t MOTOR_PWM[AXES] = {9, 10}, MOTOR_DIRECTION[AXES] = {7, 8};
static const uint8_t ENABLE = 6;       /* of both drivers; with an external pull-down: without power there is no force */
static const uint8_t STOP_BUTTON = 11; /* normally closed to ground: pressed, unplugged and broken all read HIGH */
static const uint8_t DEADMAN = 12;     /* closes to ground while it is held: released, unplugged and broken all read HIGH */
/* One step of force must be one step of the PWM, because the host computes its limits from the force step in INFO. Teensy 4
 * has up to 15 bits. A board with 8 bits has steps of 47 mN at 12 N, and no analogWriteResolution(). */
#ifdef __AVR__
#define PWM_BITS 8
#else
#define PWM_BITS 12
#endif
static const uint16_t FULL_STEPS = (uint16_t)((1UL << PWM_BITS) - 1);
static const uint32_t FULL_FORCE_UN = 12000000; /* at full PWM, from your motor's constant */
static const uint32_t WATCHDOG_MS = 20;         /* the board resets itself after this time without a tick */

static hl_device device;
static volatile int32_t position[AXES];
static uint32_t due;
static uint8_t queue[HL_MAX_OUT]; /* bytes that wait for room in the board's buffer */
static size_t queued, gone;       /* number of bytes in `queue`, and how many of them were sent */

static void edge(uint8_t axis) /* one count for every edge of channel A */
{
  bool same = digitalRead(ENCODER_A[axis]) == digitalRead(ENCODER_B[axis]);
  position[axis] = position[axis] + (same ? 1 : -1);
}
static void edge0() { edge(0); }
static void edge1() { edge(1); }

/* ---- functions: adapt them to your device ----------------------------------------------------------------------- */

static void readEncoders(int32_t *counts)
{
  noInterrupts();
  for (uint8_t a = 0; a < AXES; a++) counts[a] = position[a];
  interrupts();
}

/* Sets the motors to forces in steps, positive towards growing counts. */
static void writeForces(const int16_t *force)
{
  for (uint8_t a = 0; a < AXES; a++) {
    int32_t size = force[a] < 0 ? -(int32_t)force[a] : force[a];
    digitalWrite(MOTOR_DIRECTION[a], force[a] < 0 ? HIGH : LOW);
    analogWrite(MOTOR_PWM[a], (int)size);
  }
  digitalWrite(ENABLE, hl_running(&device) ? HIGH : LOW);
}

/* Returns the next byte, or -1 if there is none. */
static int serialRead() { return Serial.available() > 0 ? Serial.read() : -1; }

/* Sends as much of the queue as the board takes now, without waiting: while a sketch waits, its link watchdog cannot act. */
static void serialPump()
{
  int room = Serial.availableForWrite();
  if (gone == queued || room <= 0) return;
  size_t n = queued - gone < (size_t)room ? queued - gone : (size_t)room;
  gone += Serial.write(queue + gone, n);
}

/* Sends all n bytes or none, so that no frame is cut in two. While the queue is partly sent, drops the new
 * bytes; otherwise they replace the queue. */
static void serialWrite(const uint8_t *data, size_t n)
{
  serialPump();
  if ((gone > 0 && gone < queued) || n > sizeof queue) return;
  for (size_t i = 0; i < n; i++) queue[i] = data[i];
  queued = n;
  gone = 0;
  serialPump();
}

static uint32_t timeUs() { return (uint32_t)micros(); }

/* ---- setup and loop: change only the numbers of INFO -------------------------------------------------------------- */

void setup()
{
  hl_info info = {"example 1", 1, PERIOD_US * 1000, AXES, {}};
  for (uint8_t a = 0; a < AXES; a++) {
    /* damping [uN s/m], pm per count, uN per step, largest force [steps], workspace [counts] */
    hl_axis axis = {1370000, 10000000, (FULL_FORCE_UN + FULL_STEPS / 2) / FULL_STEPS, FULL_STEPS, 8000};
    info.axis[a] = axis;
    pinMode(ENCODER_A[a], INPUT_PULLUP);
    pinMode(ENCODER_B[a], INPUT_PULLUP);
    pinMode(MOTOR_PWM[a], OUTPUT);
    pinMode(MOTOR_DIRECTION[a], OUTPUT);
  }
  pinMode(ENABLE, OUTPUT);
  digitalWrite(ENABLE, LOW);
  pinMode(STOP_BUTTON, INPUT_PULLUP);
  pinMode(DEADMAN, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(ENCODER_A[0]), edge0, CHANGE);
  attachInterrupt(digitalPinToInterrupt(ENCODER_A[1]), edge1, CHANGE);
#if PWM_BITS > 8
  analogWriteResolution(PWM_BITS);
#endif
  Serial.begin(2000000); /* boards with native USB ignore the rate */
  if (!hl_init(&device, &info)) /* a number in `info` is impossible: ENABLE stays low */
    for (;;) delay(1000);
  watchdogStart(WATCHDOG_MS);
  due = timeUs() + PERIOD_US;
}

void loop()
{
  int byte = 0;
  for (uint8_t n = 0; n < 64 && (byte = serialRead()) >= 0; n++) /* a flood of bytes must not delay the tick */
    if (hl_receive(&device, (uint8_t)byte, timeUs())) writeForces(device.applied);
  serialPump();
  if (digitalRead(STOP_BUTTON) == HIGH) {
    digitalWrite(ENABLE, LOW);
    hl_estop(&device);
  }

  uint32_t late = timeUs() - due;
  if (late >= 0x80000000u) return; /* not due yet */
  if (late > PERIOD_US) {          /* a whole period was lost: stop, and do not catch up */
    hl_fault(&device);
    due += late;
  }
  due += PERIOD_US;

  int32_t counts[AXES];
  int16_t force[AXES];
  uint8_t out[HL_MAX_OUT];
  readEncoders(counts);
  hl_deadman(&device, digitalRead(DEADMAN) == LOW); /* with --deadman device, the host ramps out on release */
  size_t n = hl_tick(&device, timeUs(), counts, force, out);
  writeForces(force);
  watchdogFeed(); /* only after a tick: a loop without ticks must not feed the watchdog */
  serialWrite(out, n);
}
