/* Runs an exported tick on a board without a host, and removes the force if something goes wrong.
 *
 * Include the exported file first (python -m design.export FILE.json --process --without-theta --force-limit N, with --float
 * on boards without double). Once per period the sketch sets the motors to the last `force`, samples the handles, and calls ha_tick:
 * a force acts from the tick after its sample on, so the file must be certified for theta = 1.
 *
 *   ha_home   call while the handles stand at their reference; no force acts before
 *   ha_arm    tests each axis by a small force while nobody holds its handle; then raises the gain. A range, speed or cap
 *             that is NaN or not positive ends the test (HA_LIMITS)
 *   ha_stop   ramps out (HA_ASKED, HA_DEADMAN, HA_DEAD), or drops the force at once (every other cause, and during a test)
 *   ha_tick   call once per period; it computes the forces for the next period
 */
#ifndef HAPTIC_ALONE_H
#define HAPTIC_ALONE_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#if PROCESS_THETA_INCLUDED
#error "Export with --without-theta: the sketch itself delays every force by a tick."
#endif
#if PROCESS_THETA_LEAST != 1 || PROCESS_THETA_MOST != 1
#error "The sketch delays every force by one tick: the scenario must have theta = 1 for each axis."
#endif
#if PROCESS_FORCE_LIMIT_MN == 0
#error "Export with --force-limit: no certificate covers forces that the sketch clips."
#endif

#if !PROCESS_CERTIFIED
#error "The exported file is not certified: export a coupling whose proof python -m design.check confirms."
#endif
#if PROCESS_ROTARY
#error "The sketch measures metres and newtons: export a scenario without unit = rad."
#endif
#if PROCESS_PERIOD_NS > 4000000
#error "The sketch tests its axes with a T of at most 4 ms."
#endif

#ifndef HA_REAL
#define HA_REAL double /* float if the file was exported with --float */
#endif
typedef HA_REAL ha_real;

#define HA_RISE 0.25f    /* [s] from zero to full gain */
#define HA_FALL 0.1f     /* [s] from full gain to zero */
#define HA_TEST_MAX 0.8f /* [N] test force in the last block, or half the cap if that is less */
#define HA_SWING 0.03f   /* [s] between two changes of the test force's sign */
#define HA_BLOCKS 4      /* blocks of four swings; each is twice as strong as the one before */
#define HA_DEGREE 5      /* degree of the polynomial subtracted from a motion to remove gravity, drift and the hand */
#define HA_FIT 0.8f      /* least share of a motion's sum of squares with the shape of a free mass's answer */
#define HA_REST 0.1f     /* [s] window without forces in which the noise of the sensors is measured */
#define HA_PRESSING 0.3f /* [N], or half the cap if less: a sensor at rest for HA_PRESSED [s] under a larger force is dead */
#define HA_PRESSED 0.5f

enum { HA_HOMING, HA_READY, HA_TESTING, HA_RUNNING, HA_STOPPING };
enum { HA_NONE, HA_ASKED, HA_DEADMAN, HA_LATE, HA_RANGE, HA_SPEED, HA_SIGN, HA_DEAD, HA_SCALE, HA_LIMITS };

/* ticks of a block, and the weights of the recursion p[k + 1] = u p[k] - weight[k] p[k - 1] of polynomials that are orthogonal
 * over these ticks, u from -1 to 1 */
#define HA_TICKS (8 * (uint16_t)(HA_SWING / 2 / PROCESS_PERIOD + 0.5f))
#define HA_WEIGHT(k) ((ha_real)(k * k) * (1 - (ha_real)(k * k) / ((ha_real)HA_TICKS * HA_TICKS)) / (4 * k * k - 1))
static const ha_real HA_WEIGHTS[HA_DEGREE + 1] = {0, HA_WEIGHT(1), HA_WEIGHT(2), HA_WEIGHT(3), HA_WEIGHT(4), HA_WEIGHT(5)};

typedef struct {
    ha_real range; /* [m] a handle beyond +-range stops the session */
    ha_real speed; /* [m/s] a faster handle stops the session */
    ha_real cap;   /* [N] largest force; a test force is at most half of it */
    ha_real count; /* [m] encoder step */
    ha_real mass;  /* [kg] of a handle that nobody holds; without it no axis passes its test */
} ha_limits;

typedef struct { /* the test of one axis: sums over the ticks of a block */
    uint16_t tick;
    uint8_t block;
    ha_real acting;              /* [N] force since the last tick */
    ha_real velocity, path, from; /* the force integrated once [N s] and twice [N s2]; position [m] at the block's start */
    ha_real paths, moves, both;  /* sums of path squared, motion squared, and path times motion */
    ha_real path_in[HA_DEGREE + 1], move_in[HA_DEGREE + 1]; /* sums of products with the orthogonal polynomials */
} ha_answer;

typedef struct {
    process_state process;
    uint8_t phase, cause, axis; /* axis: the axis under test */
    uint16_t rested;            /* ticks of the window in which noise is measured */
    bool known;                 /* whether the noise of the sensors is known */
    ha_answer answer;
    ha_real gain;
    ha_real before[PROCESS_CHANNELS], older[PROCESS_CHANNELS]; /* [m] positions at the last tick and the tick before */
    ha_real reference[PROCESS_CHANNELS], force[PROCESS_CHANNELS];
    ha_real low[PROCESS_CHANNELS], high[PROCESS_CHANNELS]; /* [m] extremes since the last motion; in ha_listen high is the noise */
    ha_real still[PROCESS_CHANNELS];                       /* [m] range in which a sensor rests */
    uint16_t pressed[PROCESS_CHANNELS];                    /* ticks in a row under a force without a motion */
} ha_runner;

/* Removes the forces, and begins to measure the noise of the sensors. */
static inline void ha_rest(ha_runner *r)
{
    int i;
    r->phase = HA_READY;
    r->rested = 0;
    for (i = 0; i < PROCESS_CHANNELS; i++) r->force[i] = 0;
}

static inline void ha_home(ha_runner *r)
{
    int i;
    ha_rest(r);
    r->cause = HA_NONE;
    r->known = false;
    for (i = 0; i < PROCESS_CHANNELS; i++) r->before[i] = r->older[i] = 0;
}

static inline void ha_block(ha_runner *r, uint8_t block)
{
    memset(&r->answer, 0, sizeof r->answer);
    r->answer.block = block;
    r->answer.from = r->before[r->axis];
}

static inline void ha_arm(ha_runner *r)
{
    if (r->phase != HA_READY) return;
    r->phase = HA_TESTING;
    r->cause = HA_NONE;
    r->gain = 0;
    r->axis = 0;
    ha_block(r, 0);
}

static inline void ha_stop(ha_runner *r, uint8_t cause)
{
    bool ramp = cause == HA_ASKED || cause == HA_DEADMAN || cause == HA_DEAD;
    if (r->phase < HA_TESTING || (r->phase == HA_STOPPING && ramp)) return;
    if (r->phase != HA_STOPPING) r->cause = cause; /* the first cause stays */
    if (r->phase == HA_RUNNING && ramp) r->phase = HA_STOPPING;
    else ha_rest(r);
}

/* Measures the noise of the sensors while no force acts: the largest second difference of positions in a window, which a
 * hand that moves the handle hardly changes. The least of all windows counts. */
static inline void ha_listen(ha_runner *r, const ha_limits *l, const ha_real *x)
{
    int i;
    for (i = 0; i < PROCESS_CHANNELS; i++) {
        ha_real bend = x[i] - 2 * r->before[i] + r->older[i];
        if (bend < 0) bend = -bend;
        if (!(bend <= l->range)) { /* an outlier or NaN: the window begins anew */
            r->rested = 0;
            return;
        }
        if (r->rested == 0 || bend > r->high[i]) r->high[i] = bend;
    }
    if (++r->rested < (uint16_t)(HA_REST / PROCESS_PERIOD)) return;
    r->rested = 0;
    for (i = 0; i < PROCESS_CHANNELS; i++) { /* 1.5: noise goes farther in a longer time; a broken channel toggles by a count */
        ha_real still = (ha_real)1.5 * (r->high[i] + l->count);
        if (!r->known || still < r->still[i]) r->still[i] = still;
    }
    r->known = true;
}

/* Starts the coupling where the handles are. */
static inline void ha_begin(ha_runner *r, const ha_real *x)
{
    int i;
    process_reset(&r->process);
    for (i = 0; i < PROCESS_CHANNELS; i++) {
        r->reference[i] = r->low[i] = r->high[i] = x[i];
        r->pressed[i] = 0;
    }
}

/* Judges a block. The motion of a free mass is the twice integrated force over the mass; both are compared after the
 * polynomials of degree HA_DEGREE are subtracted from them. */
static inline void ha_judge(ha_runner *r, const ha_limits *l)
{
    ha_answer *a = &r->answer;
    ha_real norm = HA_TICKS, size;
    bool follows;
    int k;
    for (k = 0; k <= HA_DEGREE; k++) {
        if (k) norm *= HA_WEIGHTS[k];
        a->paths -= a->path_in[k] * a->path_in[k] / norm;
        a->moves -= a->move_in[k] * a->move_in[k] / norm;
        a->both -= a->path_in[k] * a->move_in[k] / norm;
    }
    size = l->mass * a->both / a->paths;
    follows = a->both * a->both >= (ha_real)HA_FIT * a->paths * a->moves && a->moves > HA_TICKS * l->count * l->count / 6;
    if (follows && size < 0) {
        ha_stop(r, HA_SIGN);
    } else if (follows && size > 2) {
        ha_stop(r, HA_SCALE);
    } else if (follows && size >= (ha_real)0.5) {
        if (++r->axis < PROCESS_CHANNELS) ha_block(r, 0);
        else r->phase = HA_RUNNING; /* from the next tick on */
    } else if (a->block + 1 < HA_BLOCKS) { /* a stronger force: friction hides small motions */
        ha_block(r, (uint8_t)(a->block + 1));
    } else {
        ha_stop(r, follows ? HA_SCALE : HA_DEAD);
    }
}

/* Pushes the axis by a force that changes its sign, and sums up the motion. In the tick after a block it only judges the
 * block, because pushing and judging in one tick take too long for an ATmega328P. */
static inline void ha_test(ha_runner *r, const ha_limits *l, const ha_real *x)
{
    ha_answer *a = &r->answer;
    ha_real most = l->cap / 2 < (ha_real)HA_TEST_MAX ? l->cap / 2 : (ha_real)HA_TEST_MAX;
    ha_real u = (2 * (int)a->tick - (int)(HA_TICKS - 1)) * ((ha_real)1 / HA_TICKS), p = 1, last = 0, motion;
    int k;
    if (a->tick == HA_TICKS) {
        ha_judge(r, l);
        return;
    }
    motion = x[r->axis] - a->from;
    a->path += (a->velocity + a->acting * (ha_real)(PROCESS_PERIOD / 2)) * (ha_real)PROCESS_PERIOD;
    a->velocity += a->acting * (ha_real)PROCESS_PERIOD;
    a->acting = r->force[r->axis];
    a->paths += a->path * a->path;
    a->moves += motion * motion;
    a->both += a->path * motion;
    for (k = 0; k <= HA_DEGREE; k++) {
        ha_real next = u * p - HA_WEIGHTS[k] * last;
        a->path_in[k] += p * a->path;
        a->move_in[k] += p * motion;
        last = p;
        p = next;
    }
    a->tick++;
    for (k = a->block + 1; k < HA_BLOCKS; k++) most /= 2;
    if (a->tick == HA_TICKS) most = 0;
    r->force[r->axis] = (a->tick + HA_TICKS / 8) / (HA_TICKS / 4) % 2 ? -most : most;
}

/* Ramps out if a sensor stands still under a force: no hand holds a pushed handle within the noise for half a second. */
static inline void ha_watch(ha_runner *r, const ha_limits *l, const ha_real *x)
{
    ha_real least = l->cap / 2 < (ha_real)HA_PRESSING ? l->cap / 2 : (ha_real)HA_PRESSING;
    int i;
    for (i = 0; i < PROCESS_CHANNELS; i++) {
        if (x[i] < r->low[i]) r->low[i] = x[i];
        if (x[i] > r->high[i]) r->high[i] = x[i];
        bool moves = r->high[i] - r->low[i] > r->still[i];
        if (moves) r->low[i] = r->high[i] = x[i];
        if (moves || (r->force[i] <= least && r->force[i] >= -least)) r->pressed[i] = 0;
        else if (++r->pressed[i] > (uint16_t)(HA_PRESSED / PROCESS_PERIOD)) ha_stop(r, HA_DEAD);
    }
}

/* Takes the positions x [m] of this tick and computes r->force [N] for the next tick, positive towards positive x. */
static inline void ha_tick(ha_runner *r, const ha_limits *l, const ha_real *x)
{
    const ha_real rise = (ha_real)(PROCESS_PERIOD / HA_RISE), fall = (ha_real)(PROCESS_PERIOD / HA_FALL);
    ha_real most = l->speed * (ha_real)PROCESS_PERIOD, from[PROCESS_CHANNELS], f[PROCESS_CHANNELS];
    int i;
    if (r->phase == HA_TESTING && !(l->range > 0 && l->speed > 0 && l->cap > 0)) ha_stop(r, HA_LIMITS);
    for (i = 0; i < PROCESS_CHANNELS; i++) {
        ha_real step = x[i] - r->before[i];
        if (!(x[i] <= l->range && x[i] >= -l->range)) ha_stop(r, HA_RANGE); /* NaN fails both comparisons */
        if (!(step <= most && step >= -most)) ha_stop(r, HA_SPEED);
    }
    if (r->phase == HA_RUNNING && r->gain == 0) ha_begin(r, x);
    if (r->phase == HA_RUNNING) ha_watch(r, l, x);
    if (r->phase == HA_READY || (r->phase == HA_TESTING && !r->known)) {
        ha_listen(r, l, x);
    } else if (r->phase == HA_TESTING) {
        ha_test(r, l, x);
    } else if (r->phase != HA_HOMING) {
        for (i = 0; i < PROCESS_CHANNELS; i++) from[i] = x[i] - r->reference[i];
        process_step(&r->process, from, f);
        r->gain += r->phase == HA_RUNNING ? rise : -fall;
        if (r->gain > 1) r->gain = 1;
        for (i = 0; i < PROCESS_CHANNELS; i++) {
            ha_real force = -r->gain * f[i]; /* the devices feel -f */
            r->force[i] = force > l->cap ? l->cap : force < -l->cap ? -l->cap : force;
        }
        if (r->gain <= 0) ha_rest(r);
    }
    for (i = 0; i < PROCESS_CHANNELS; i++) {
        r->older[i] = r->before[i];
        r->before[i] = x[i];
    }
}

#endif
