/* Runs an exported tick on a board without a host, and removes the force if something goes wrong.
 *
 * Include the exported file first (python -m design.export FILE.json --process --without-theta, with --float on boards
 * without double). Once per period the sketch sets the motors to the last `force`, samples the handles, and calls ha_tick:
 * a force acts from the tick after its sample on, so the file must be certified for theta = 1.
 *
 *   ha_home   call while the handles stand at their reference; no force acts before
 *   ha_arm    tests each axis by a small force, then raises the gain
 *   ha_stop   ramps out (HA_ASKED, HA_DEADMAN), or drops the force at once (every other cause, and during a test)
 *   ha_tick   call once per period; it computes the forces for the next period
 */
#ifndef HAPTIC_ALONE_H
#define HAPTIC_ALONE_H

#include <stdbool.h>
#include <stdint.h>

#ifndef HA_REAL
#define HA_REAL double /* float if the file was exported with --float */
#endif
typedef HA_REAL ha_real;

#define HA_RISE 0.25f   /* [s] from zero to full gain */
#define HA_FALL 0.1f    /* [s] from full gain to zero */
#define HA_TEST_MAX 0.8f /* [N] an axis is dead if neither this force nor half the cap moves it */
#define HA_TEST 0.2f    /* [s] in which the test force grows to its maximum */
#define HA_SWING 0.03f  /* [s] after which the test force changes its sign */

enum { HA_HOMING, HA_READY, HA_TESTING, HA_RUNNING, HA_STOPPING };
enum { HA_NONE, HA_ASKED, HA_DEADMAN, HA_LATE, HA_RANGE, HA_SPEED, HA_SIGN, HA_DEAD };

typedef struct {
    ha_real range; /* [m] a handle beyond +-range stops the session */
    ha_real speed; /* [m/s] a faster handle stops the session */
    ha_real cap;   /* [N] largest force; a test force is at most half of it */
    ha_real count; /* [m] encoder step; a test ends after a path of 12 steps */
} ha_limits;

typedef struct {
    process_state process;
    uint8_t phase, cause, axis; /* axis: the one under test */
    uint16_t tick;              /* ticks of the test so far */
    ha_real gain, path, work;   /* path [m] and work [J] of the axis under test */
    ha_real before[PROCESS_CHANNELS], reference[PROCESS_CHANNELS], force[PROCESS_CHANNELS];
} ha_runner;

static inline void ha_home(ha_runner *r)
{
    int i;
    r->phase = HA_READY;
    r->cause = HA_NONE;
    r->gain = 0;
    for (i = 0; i < PROCESS_CHANNELS; i++) r->before[i] = r->force[i] = 0;
}

static inline void ha_test_axis(ha_runner *r, uint8_t axis)
{
    r->axis = axis;
    r->tick = 0;
    r->path = r->work = 0;
}

static inline void ha_arm(ha_runner *r)
{
    if (r->phase != HA_READY) return;
    r->phase = HA_TESTING;
    r->cause = HA_NONE;
    r->gain = 0;
    ha_test_axis(r, 0);
}

static inline void ha_stop(ha_runner *r, uint8_t cause)
{
    int i;
    if (r->phase != HA_TESTING && r->phase != HA_RUNNING) return;
    r->cause = cause;
    if (r->phase == HA_RUNNING && (cause == HA_ASKED || cause == HA_DEADMAN)) {
        r->phase = HA_STOPPING;
        return;
    }
    r->phase = HA_READY;
    for (i = 0; i < PROCESS_CHANNELS; i++) r->force[i] = 0;
}

/* The test force changes its sign and grows until the handle has moved. Its work on a passive handle is positive; a wrong
 * sign of motor or sensor makes the work negative. */
static inline void ha_test(ha_runner *r, const ha_limits *l, const ha_real *x)
{
    ha_real step = x[r->axis] - r->before[r->axis], most = l->cap / 2 < (ha_real)HA_TEST_MAX ? l->cap / 2 : (ha_real)HA_TEST_MAX;
    ha_real size = most * (ha_real)(PROCESS_PERIOD / HA_TEST) * r->tick;
    uint16_t swing = (uint16_t)(HA_SWING / PROCESS_PERIOD);
    r->work += r->force[r->axis] * step;
    r->path += step < 0 ? -step : step;
    r->force[r->axis] = 0;
    if (r->path > 12 * l->count) {
        if (r->work <= 0) {
            ha_stop(r, HA_SIGN);
        } else if (r->axis + 1 < PROCESS_CHANNELS) {
            ha_test_axis(r, (uint8_t)(r->axis + 1));
        } else {
            int i;
            process_reset(&r->process);
            for (i = 0; i < PROCESS_CHANNELS; i++) r->reference[i] = x[i];
            r->phase = HA_RUNNING;
        }
    } else if (size > most) {
        ha_stop(r, HA_DEAD);
    } else {
        r->force[r->axis] = (r->tick / swing) % 2 ? -size : size;
        r->tick++;
    }
}

/* Takes the positions x [m] of this tick and computes r->force [N] for the next tick, positive towards positive x. */
static inline void ha_tick(ha_runner *r, const ha_limits *l, const ha_real *x)
{
    const ha_real rise = (ha_real)(PROCESS_PERIOD / HA_RISE), fall = (ha_real)(PROCESS_PERIOD / HA_FALL);
    ha_real most = l->speed * (ha_real)PROCESS_PERIOD, from[PROCESS_CHANNELS], f[PROCESS_CHANNELS];
    int i;
    for (i = 0; i < PROCESS_CHANNELS; i++) {
        ha_real step = x[i] - r->before[i];
        if (x[i] > l->range || x[i] < -l->range) ha_stop(r, HA_RANGE);
        if (step > most || step < -most) ha_stop(r, HA_SPEED);
    }
    if (r->phase == HA_TESTING) ha_test(r, l, x);
    if (r->phase == HA_RUNNING || r->phase == HA_STOPPING) {
        for (i = 0; i < PROCESS_CHANNELS; i++) from[i] = x[i] - r->reference[i];
        process_step(&r->process, from, f);
        r->gain += r->phase == HA_RUNNING ? rise : -fall;
        if (r->gain > 1) r->gain = 1;
        if (r->gain <= 0) {
            r->gain = 0;
            r->phase = HA_READY;
        }
        for (i = 0; i < PROCESS_CHANNELS; i++) {
            ha_real force = -r->gain * f[i]; /* the devices feel -f */
            r->force[i] = force > l->cap ? l->cap : force < -l->cap ? -l->cap : force;
        }
    }
    for (i = 0; i < PROCESS_CHANNELS; i++) r->before[i] = x[i];
}

#endif
