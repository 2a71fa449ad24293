/* Plain functions around haptic_link.h for ctypes, and a sanitized executable for scripts on standard input. */
#include "haptic_link.h"

#include <stdio.h>
#include <stdlib.h>

size_t harness_size(void) { return sizeof(hl_device); }

/* `values` has five numbers per axis, in the order of INFO */
int harness_init(hl_device *d, const char *firmware, uint32_t serial, uint32_t period_ns, int axes, const uint32_t *values)
{
    hl_info info;
    int a;
    memset(&info, 0, sizeof info);
    strncpy(info.firmware, firmware, sizeof info.firmware - 1);
    info.serial = serial;
    info.period_ns = period_ns;
    info.axes = (uint8_t)axes;
    for (a = 0; a < axes && a < HL_MAX_AXES; a++) {
        const uint32_t *v = values + 5 * a;
        hl_axis axis;
        axis.osp_damping = v[0];
        axis.encoder_step = v[1];
        axis.force_step = v[2];
        axis.hard_limit = (uint16_t)v[3];
        axis.range = (int32_t)v[4];
        info.axis[a] = axis;
    }
    return hl_init(d, &info);
}

/* Sets the motors when hl_receive asks for it, and returns how often it asked. */
int harness_receive(hl_device *d, const uint8_t *data, size_t n, uint32_t now, int16_t *motors)
{
    int count = 0;
    while (n--)
        if (hl_receive(d, *data++, now)) {
            memcpy(motors, d->applied, d->info.axes * sizeof *motors);
            count++;
        }
    return count;
}

size_t harness_tick(hl_device *d, uint32_t now, const int32_t *counts, int16_t *force, uint8_t *out)
{
    return hl_tick(d, now, counts, force, out);
}

void harness_estop(hl_device *d) { hl_estop(d); }
void harness_fault(hl_device *d) { hl_fault(d); }
void harness_number(hl_device *d, uint32_t tick) { d->k = (uint16_t)tick; }
void harness_deadman(hl_device *d, int held) { hl_deadman(d, held != 0); }

int harness_look(const hl_device *d, int what)
{
    return what == 0 ? d->phase : what == 1 ? d->cause : what == 2 ? d->k : d->misses;
}

#ifdef HARNESS_MAIN
static uint32_t word(void)
{
    uint8_t b[4];
    if (fread(b, 1, 4, stdin) != 4) exit(0); /* the script ends between two operations */
    return (uint32_t)b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
}

/* Operations of 32-bit words: R now n bytes.. | T now counts.. | E | F | D held | K tick; every tick answers:
 * n (16 bits), n bytes, a force (16 bits) per axis */
int main(void)
{
    uint32_t values[5 * 9], serial = word(), period_ns = word(), axes = word(), a; /* 9: one axis too many */
    hl_device *d = (hl_device *)malloc(sizeof *d);
    int16_t *force = (int16_t *)malloc(axes * sizeof *force);
    for (a = 0; a < 5 * axes; a++) values[a] = word();
    if (!d || !force) return 1;
    if (harness_init(d, "harness", serial, period_ns, (int)axes, values) != (axes <= HL_MAX_AXES)) return 1;
    for (;;) {
        uint32_t operation = word();
        if (operation == 'E') harness_estop(d);
        else if (operation == 'F') harness_fault(d);
        else if (operation == 'D') harness_deadman(d, (int)word());
        else if (operation == 'K') harness_number(d, word());
        else if (operation == 'R') {
            uint32_t now = word(), n = word();
            uint8_t *data = (uint8_t *)malloc(n ? n : 1); /* n bytes exactly, so that the sanitizer finds an access beyond them */
            if (!data || fread(data, 1, n, stdin) != n) return 1;
            harness_receive(d, data, n, now, force);
            free(data);
        } else if (operation == 'T') {
            uint32_t now = word();
            int32_t *counts = (int32_t *)malloc(axes * sizeof *counts);
            uint8_t *out = (uint8_t *)malloc(HL_MAX_OUT), head[2];
            size_t n;
            if (!counts || !out) return 1;
            for (a = 0; a < axes; a++) counts[a] = (int32_t)word();
            n = harness_tick(d, now, counts, force, out);
            hl_put16(head, (uint16_t)n);
            fwrite(head, 1, 2, stdout);
            fwrite(out, 1, n, stdout);
            for (a = 0; a < axes; a++) {
                hl_put16(head, (uint16_t)force[a]);
                fwrite(head, 1, 2, stdout);
            }
            free(counts);
            free(out);
        } else return 1;
    }
}
#endif
