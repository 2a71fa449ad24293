/* A two-axis device on the serial link: quadrature encoders, PWM and direction to two motor drivers, an enable line and
 * an emergency stop. Written for Teensy 4, whose Serial is native USB. On another board check three things: that Serial is
 * the port you plug in (some boards call their native USB SerialUSB), that its core has availableForWrite() and it returns
 * more than 0 on an idle line (print it once: where it is always 0, nothing is ever sent), and what it returns then. Two
 * axes send an INFO of 68 bytes and STATEs of 32; where the idle line takes less than both at once, they wait in `queue`
 * and leave piece by piece, which delays a STATE: the host measures that as part of the round trip. Put haptic_link.h,
 * haptic_frame.h and board_watchdog.h beside it.
 *
 * Yours to change: the pins, the numbers of INFO (measure them; docs/protocol.md says what the host does with each), and
 * the functions below them. Everything that keeps hands whole is in haptic_link.h: leave it as it is. */
#include <Arduino.h>

#include "board_watchdog.h"
#include "haptic_link.h"

static const uint8_t AXES = 2;
static const uint32_t PERIOD_US = 1200;
static const uint8_t ENCODER_A[AXES] = {2, 4}, ENCODER_B[AXES] = {3, 5};
static const uint8_t MOTOR_PWM[AXES] = {9, 10}, MOTOR_DIRECTION[AXES] = {7, 8};
static const uint8_t ENABLE = 6;       /* of both drivers; pulled down outside: an unpowered board means no force */
static const uint8_t STOP_BUTTON = 11; /* normally closed, to ground: pressed, unplugged and broken all read HIGH */
static const uint8_t DEADMAN = 12;     /* closed to ground while it is held: let go, unplugged and broken all read HIGH */
/* A step of force is a step of the PWM, no finer: what INFO says of it, the host's limits rest on. Teensy 4 has up to 15
 * bits; a board whose analogWrite knows no more than 8 has steps of 47 mN at 12 N, and no analogWriteResolution(). */
static const uint8_t PWM_BITS = 12;
static const uint16_t FULL_STEPS = (uint16_t)((1UL << PWM_BITS) - 1);
static const uint32_t FULL_FORCE_UN = 12000000; /* at full PWM, from your motor's constant */
static const uint32_t WATCHDOG_MS = 20;         /* the board resets itself where no tick came for so long */

static hl_device device;
static volatile int32_t position[AXES];
static uint32_t due;
static uint8_t queue[HL_MAX_OUT]; /* bytes that the board's buffer had no room for yet */
static size_t queued, gone;       /* how many there are, and how many of them have left */

static void edge(uint8_t axis) /* one count for every edge of channel A */
{
  bool same = digitalRead(ENCODER_A[axis]) == digitalRead(ENCODER_B[axis]);
  position[axis] = position[axis] + (same ? 1 : -1);
}
static void edge0() { edge(0); }
static void edge1() { edge(1); }

/* ---- the functions: what only you know -------------------------------------------------------------------------- */

static void readEncoders(int32_t *counts)
{
  noInterrupts();
  for (uint8_t a = 0; a < AXES; a++) counts[a] = position[a];
  interrupts();
}

/* A force in steps, positive towards growing counts. */
static void writeForces(const int16_t *force)
{
  for (uint8_t a = 0; a < AXES; a++) {
    int32_t size = force[a] < 0 ? -(int32_t)force[a] : force[a];
    digitalWrite(MOTOR_DIRECTION[a], force[a] < 0 ? HIGH : LOW);
    analogWrite(MOTOR_PWM[a], (int)size);
  }
  digitalWrite(ENABLE, hl_running(&device) ? HIGH : LOW);
}

/* The next byte, -1 where none waits. */
static int serialRead() { return Serial.available() > 0 ? Serial.read() : -1; }

/* As much of the queue as the board takes now, and never waiting: a device that waits for its host has no watchdog. */
static void serialPump()
{
  int room = Serial.availableForWrite();
  if (gone == queued || room <= 0) return;
  size_t n = queued - gone < (size_t)room ? queued - gone : (size_t)room;
  gone += Serial.write(queue + gone, n);
}

/* All of it or nothing, so that no frame is ever cut in two: it is dropped while older bytes are on their way, and takes
 * the place of older bytes of which none has left. */
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

/* ---- the loop: leave as it is ----------------------------------------------------------------------------------- */

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
  if (PWM_BITS > 8) analogWriteResolution(PWM_BITS);
  Serial.begin(2000000); /* boards with native USB ignore the rate */
  if (!hl_init(&device, &info)) /* a number above is impossible: ENABLE stays low */
    for (;;) delay(1000);
  watchdogStart(WATCHDOG_MS);
  due = timeUs() + PERIOD_US;
}

void loop()
{
  int byte = 0;
  for (uint8_t n = 0; n < 64 && (byte = serialRead()) >= 0; n++) /* a flood of bytes must not keep the tick waiting */
    if (hl_receive(&device, (uint8_t)byte, timeUs())) writeForces(device.applied);
  serialPump();
  if (digitalRead(STOP_BUTTON) == HIGH) {
    digitalWrite(ENABLE, LOW);
    hl_estop(&device);
  }

  uint32_t late = timeUs() - due;
  if (late >= 0x80000000u) return; /* not due yet */
  if (late > PERIOD_US) {          /* a whole period was lost: say so, and do not catch up */
    hl_fault(&device);
    due += late;
  }
  due += PERIOD_US;

  int32_t counts[AXES];
  int16_t force[AXES];
  uint8_t out[HL_MAX_OUT];
  readEncoders(counts);
  hl_deadman(&device, digitalRead(DEADMAN) == LOW); /* --deadman device: without it the host ramps forces out */
  size_t n = hl_tick(&device, timeUs(), counts, force, out);
  writeForces(force);
  watchdogFeed(); /* here and nowhere else: a loop that turns without ticks must not feed it */
  serialWrite(out, n);
}
