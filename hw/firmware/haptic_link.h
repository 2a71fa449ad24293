/* The device's side of the serial link in portable C99 (and C++11): no floats, no malloc, no clock and no port.
 * docs/protocol.md states the rules and every byte; haptic_frame.h has the frames. The tests compare this state machine with
 * hw/device_state.py byte for byte.
 *
 *   hl_init     call once; the device is then silent and its motors carry no force
 *   hl_receive  call for every byte that comes; if it returns true, set the motors to d->applied at once
 *   hl_tick     call once per period; it writes the forces that act from now on, and the bytes to send
 *   hl_estop, hl_fault, hl_deadman   call at any time in the context that calls hl_tick (not in an interrupt)
 *
 * If memory is scarce, define HL_MAX_AXES (1 to 8) before including this file. */
#ifndef HAPTIC_LINK_H
#define HAPTIC_LINK_H

#include "haptic_frame.h"

#include <string.h>

#ifndef HL_MAX_AXES
#define HL_MAX_AXES 8
#endif
#if HL_MAX_AXES < 1 || HL_MAX_AXES > 8
#error "HL_MAX_AXES: 1 to 8"
#endif
#define HL_PROTOCOL 2
#define HL_MAX_THETA 15
#define HL_SLOTS 16                 /* forces that wait for their tick: a power of two above HL_MAX_THETA */
#define HL_MAX_RELEASE_NS 20000000u /* longest sum of hold and ramp */
#define HL_NO_MARGIN (-32767 - 1)   /* no usable FORCE came since the last STATE */
#define HL_MAX_OUT (HL_MAX_FRAME + 1 + 12 + 20 + 6 * HL_MAX_AXES) /* INFO, ACK and STATE in one tick */

enum { HL_HELLO = 1, HL_INFO, HL_CONFIG, HL_ACK, HL_STATE, HL_FORCE, HL_STOP };
enum { HL_SILENT, HL_DISARMED, HL_ARMED, HL_HOLDING, HL_RAMP, HL_STOPPED, HL_ESTOP };
enum { HL_NONE, HL_BY_HOST, HL_WATCHDOG, HL_BY_COMMAND, HL_BY_DEVICE, HL_ESTOP_DEVICE, HL_ESTOP_HOST };
enum { HL_IDLE, HL_ARM, HL_RUN };
enum { HL_ACCEPTED, HL_NOT_RUNNING, HL_NOT_ESTOP, HL_NOT_AXES, HL_NOT_THETA, HL_NOT_RELEASE, HL_NOT_CAP, HL_NOT_SLEW };
enum { HL_REASON_ESTOP = 3 };

typedef struct {
    uint32_t osp_damping;  /* guaranteed damping [uN s/m] */
    uint32_t encoder_step; /* [pm per count] */
    uint32_t force_step;   /* [uN per step] */
    uint16_t hard_limit;   /* largest force [steps], at most 32767 */
    int32_t range;         /* the workspace is +-range [counts] */
} hl_axis;

typedef struct {
    char firmware[17]; /* at most 16 ASCII characters */
    uint32_t serial;
    uint32_t period_ns; /* 100 us to 100 ms */
    uint8_t axes;
    hl_axis axis[HL_MAX_AXES];
} hl_info;

typedef struct {
    uint8_t theta, hold, ramp;
    uint16_t ramp_in, cap[HL_MAX_AXES], slew[HL_MAX_AXES];
} hl_config;

typedef struct {
    bool full;
    uint8_t command;
    int16_t force[HL_MAX_AXES];
} hl_slot;

typedef struct {
    hl_info info;
    hl_config config;
    bool configured, asked, answered, latched, deadman; /* asked: INFO is due; answered: an ACK is due */
    uint8_t phase, cause, refused, rejected, misses, held, ramp_left; /* held: missed ticks in a row; ramp_left: ticks */
    uint16_t k, echo, run; /* k: this tick; run: FORCEs since arming, at most ramp_in */
    uint32_t now, config_crc; /* now: the clock at tick k [us] */
    int16_t margin, applied[HL_MAX_AXES], ramp_from[HL_MAX_AXES];
    hl_slot slot[HL_SLOTS];
    hl_receiver in;
} hl_device;

/* ---- safety states ---------------------------------------------------------------------------------------------- */

static inline bool hl_running(const hl_device *d) { return d->phase >= HL_ARMED && d->phase <= HL_RAMP; }

static inline void hl_clear(hl_device *d)
{
    memset(d->slot, 0, sizeof d->slot);
    memset(d->applied, 0, sizeof d->applied);
    d->held = d->ramp_left = 0;
    d->echo = d->run = 0;
    d->margin = HL_NO_MARGIN;
}

/* Ramps to zero force if armed, or only stops if disarmed. In other phases nothing changes: the first cause stays. */
static inline void hl_halt(hl_device *d, uint8_t cause)
{
    if (d->phase == HL_ARMED || d->phase == HL_HOLDING) {
        memcpy(d->ramp_from, d->applied, sizeof d->applied);
        d->ramp_left = d->config.ramp;
        d->phase = HL_RAMP;
        d->cause = cause;
    } else if (d->phase == HL_DISARMED) {
        d->phase = HL_STOPPED;
        d->cause = cause;
    }
}

static inline void hl_latch_estop(hl_device *d, uint8_t cause)
{
    if (d->phase == HL_ESTOP) return;
    hl_clear(d);
    d->phase = HL_ESTOP;
    d->cause = cause;
}

static inline void hl_fault(hl_device *d) { hl_halt(d, HL_BY_DEVICE); }
static inline void hl_estop(hl_device *d) { hl_latch_estop(d, HL_ESTOP_DEVICE); }
/* Sets whether somebody holds the deadman. With several boards, the host ignores a deadman that was never held. */
static inline void hl_deadman(hl_device *d, bool held) { d->deadman = held; }

/* Returns false, and leaves the device in ESTOP, if a value of the info is impossible. */
static inline bool hl_init(hl_device *d, const hl_info *info)
{
    bool good = info->axes >= 1 && info->axes <= HL_MAX_AXES;
    uint8_t a;
    memset(d, 0, sizeof *d);
    d->info = *info;
    if (!good) d->info.axes = 0;
    hl_clear(d);
    good = good && info->period_ns >= 100000u && info->period_ns <= 100000000u;
    for (a = 0; a < d->info.axes; a++) {
        const hl_axis *x = &info->axis[a];
        good = good && x->encoder_step && x->force_step && x->hard_limit && x->hard_limit <= 32767 && x->range > 0;
    }
    if (!good) hl_latch_estop(d, HL_BY_DEVICE);
    return good;
}

/* ---- forces ------------------------------------------------------------------------------------------------------ */

static inline int16_t hl_limited(const hl_device *d, uint8_t a, int32_t force)
{
    int32_t cap = d->config.cap[a], slew = d->config.slew[a], last = d->applied[a];
    if (d->config.ramp_in) cap = (int32_t)((uint32_t)cap * d->run / d->config.ramp_in);
    force = force > cap ? cap : force < -cap ? -cap : force;
    force = force - last > slew ? last + slew : force - last < -slew ? last - slew : force;
    return (int16_t)force;
}

static inline void hl_latch(hl_device *d, const hl_slot *slot)
{
    uint8_t a;
    if (!slot->full) {
        d->phase = HL_HOLDING;
        if (d->held >= d->config.hold) hl_halt(d, HL_WATCHDOG);
        else d->held++;
    } else if (slot->command == HL_IDLE) {
        hl_halt(d, HL_BY_COMMAND);
    } else {
        d->phase = HL_ARMED;
        d->held = 0;
        if (d->run < d->config.ramp_in) d->run++;
        for (a = 0; a < d->info.axes; a++) d->applied[a] = hl_limited(d, a, slot->force[a]);
    }
}

/* Applies the force for this tick while armed, or arms if the command is ARM. */
static inline void hl_take(hl_device *d, const hl_slot *slot)
{
    if (d->phase == HL_ARMED || d->phase == HL_HOLDING) hl_latch(d, slot);
    else if (d->phase == HL_DISARMED && slot->full && slot->command == HL_ARM) d->phase = HL_ARMED;
}

/* ---- from the host ---------------------------------------------------------------------------------------------- */

static inline uint8_t hl_refuse(const hl_device *d, const hl_config *c, uint8_t axes)
{
    uint8_t a;
    if (d->phase == HL_ESTOP) return HL_NOT_ESTOP;
    if (hl_running(d)) return HL_NOT_RUNNING;
    if (axes != d->info.axes) return HL_NOT_AXES;
    if (c->theta > HL_MAX_THETA) return HL_NOT_THETA;
    if (c->ramp == 0 || (uint64_t)(c->hold + c->ramp) * d->info.period_ns > HL_MAX_RELEASE_NS) return HL_NOT_RELEASE;
    for (a = 0; a < axes; a++)
        if (c->cap[a] < 1 || c->cap[a] > d->info.axis[a].hard_limit) return HL_NOT_CAP;
    for (a = 0; a < axes; a++)
        if (c->slew[a] == 0) return HL_NOT_SLEW;
    return HL_ACCEPTED;
}

static inline void hl_configure(hl_device *d, const uint8_t *p, size_t n)
{
    hl_config c;
    uint8_t a, axes = (uint8_t)((n - 6) / 4);
    memset(&c, 0, sizeof c);
    c.theta = p[1];
    c.hold = p[2];
    c.ramp = p[3];
    c.ramp_in = hl_get16(p + 4);
    for (a = 0; a < axes && a < HL_MAX_AXES; a++) {
        c.cap[a] = hl_get16(p + 6 + 4 * a);
        c.slew[a] = hl_get16(p + 8 + 4 * a);
    }
    d->config_crc = hl_crc(p, n);
    d->refused = hl_refuse(d, &c, axes);
    d->answered = true;
    if (d->refused) return;
    hl_clear(d);
    d->config = c;
    d->configured = true;
    d->phase = HL_DISARMED;
    d->cause = HL_NONE;
}

/* Stores the first force for tick source + theta if it is in time; applies it at once if theta = 0. A force that is too late
 * still sets echo and margin. */
static inline void hl_accept(hl_device *d, const uint8_t *p, size_t n, uint32_t now)
{
    uint16_t apply_at = hl_get16(p + 2), source = hl_get16(p + 4);
    bool at_once = d->config.theta == 0;
    int16_t ahead = hl_signed((uint16_t)(apply_at - d->k + at_once)); /* ticks until the force is late */
    hl_slot *slot = &d->slot[apply_at % HL_SLOTS];
    bool zero = true;
    int64_t margin;
    size_t i;
    for (i = 6; i < n; i++) zero = zero && p[i] == 0;
    if (n != 6u + 2u * d->info.axes || p[1] > HL_RUN || (p[1] != HL_RUN && !zero)) {
        d->rejected++;
        return;
    }
    if (!d->configured || (uint16_t)(apply_at - source) != d->config.theta) return;
    if (ahead > (at_once ? 1 : d->config.theta) || (ahead > 0 && slot->full)) return;
    margin = (int64_t)ahead * d->info.period_ns / 1000 - (int64_t)(uint32_t)(now - d->now);
    d->margin = (int16_t)(margin < -32767 ? -32767 : margin > 32767 ? 32767 : margin);
    d->echo = source;
    if (ahead <= 0) return;
    slot->full = true;
    slot->command = p[1];
    for (i = 0; i < d->info.axes; i++) slot->force[i] = hl_signed(hl_get16(p + 6 + 2 * i));
    if (at_once) {
        hl_take(d, slot);
        d->latched = true;
    }
}

static inline void hl_understand(hl_device *d, const uint8_t *p, size_t n, uint32_t now)
{
    if (p[0] == HL_FORCE && n >= 8 && n <= 22 && n % 2 == 0) hl_accept(d, p, n, now);
    else if (p[0] == HL_CONFIG && n >= 10 && n <= 38 && n % 4 == 2) hl_configure(d, p, n);
    else if (p[0] == HL_HELLO && n == 2) d->asked = true;
    else if (p[0] == HL_STOP && n == 2 && p[1] == HL_REASON_ESTOP) hl_latch_estop(d, HL_ESTOP_HOST);
    else if (p[0] == HL_STOP && n == 2) hl_halt(d, HL_BY_HOST);
    else d->rejected++;
}

/* Takes a byte that came at `now` [us]. Unreadable frames are counted and dropped. Returns true if d->applied may have
 * changed, by a force with theta = 0 or by an emergency stop. */
static inline bool hl_receive(hl_device *d, uint8_t byte, uint32_t now)
{
    int n = hl_collect(&d->in, byte);
    uint8_t phase = d->phase;
    d->latched = false;
    if (n < 0) d->rejected++;
    else if (n > 0) hl_understand(d, d->in.bytes + 1, (size_t)n, now);
    return d->latched || (d->phase == HL_ESTOP && phase != HL_ESTOP);
}

/* ---- the tick --------------------------------------------------------------------------------------------------- */

static inline void hl_ramp_down(hl_device *d)
{
    int32_t left = --d->ramp_left, ramp = d->config.ramp;
    uint8_t a;
    for (a = 0; a < d->info.axes; a++) d->applied[a] = (int16_t)(d->ramp_from[a] * left / ramp);
    if (d->ramp_left == 0) d->phase = HL_STOPPED;
}

static inline size_t hl_write_info(const hl_device *d, uint8_t *out)
{
    uint8_t *p = out + 1, a;
    *p++ = HL_INFO;
    *p++ = HL_PROTOCOL;
    memset(p, 0, 16);
    for (a = 0; a < 16 && d->info.firmware[a]; a++) p[a] = (uint8_t)d->info.firmware[a];
    p = hl_put32(hl_put32(p + 16, d->info.serial), d->info.period_ns);
    for (a = 0; a < d->info.axes; a++) {
        const hl_axis *x = &d->info.axis[a];
        p = hl_put32(hl_put32(hl_put32(p, x->osp_damping), x->encoder_step), x->force_step);
        p = hl_put32(hl_put16(p, x->hard_limit), (uint32_t)x->range);
    }
    return hl_stuff(out, (size_t)(p - out - 1));
}

static inline size_t hl_write_ack(const hl_device *d, uint8_t *out)
{
    out[1] = HL_ACK;
    *hl_put32(out + 2, d->config_crc) = d->refused;
    return hl_stuff(out, 6);
}

static inline size_t hl_write_state(const hl_device *d, const int32_t *counts, uint8_t *out)
{
    uint8_t *p = out + 1, a;
    *p++ = HL_STATE;
    *p++ = (uint8_t)(d->phase | d->cause << 4 | d->deadman << 7);
    p = hl_put16(hl_put16(hl_put16(p, d->k), d->echo), (uint16_t)d->margin);
    *p++ = d->rejected;
    *p++ = d->misses;
    p = hl_put32(p, d->now);
    for (a = 0; a < d->info.axes; a++) p = hl_put16(hl_put32(p, (uint32_t)counts[a]), (uint16_t)d->applied[a]);
    return hl_stuff(out, (size_t)(p - out - 1));
}

/* Begins a period at `now` [us]; `counts` was sampled just before. Writes the forces that act from now on [steps] to `force`
 * and at most HL_MAX_OUT bytes to send to `out`; returns the number of these bytes. */
static inline size_t hl_tick(hl_device *d, uint32_t now, const int32_t *counts, int16_t *force, uint8_t *out)
{
    bool at_once = d->configured && d->config.theta == 0;
    hl_slot *slot = &d->slot[(uint16_t)(++d->k - at_once) % HL_SLOTS]; /* theta = 0: slot of the last tick, already applied */
    size_t n = 0;
    d->now = now;
    if (d->phase == HL_DISARMED || d->phase == HL_ARMED || d->phase == HL_HOLDING) {
        if (!slot->full) d->misses++;
        if (!at_once || (!slot->full && d->phase != HL_DISARMED)) hl_take(d, slot);
    }
    slot->full = false;
    if (d->phase == HL_RAMP) hl_ramp_down(d);
    memcpy(force, d->applied, d->info.axes * sizeof *force);
    if (d->asked && !hl_running(d)) {
        n += hl_write_info(d, out);
        d->asked = false;
    }
    if (d->answered) n += hl_write_ack(d, out + n);
    d->answered = false;
    if (d->configured) {
        n += hl_write_state(d, counts, out + n);
        d->margin = HL_NO_MARGIN;
    }
    return n;
}

#endif
