/* Bytes and frames of the serial link in portable C99 (and C++11): little-endian integers, CRC-32, COBS.
 * A frame on the wire is COBS(payload | CRC-32), then a zero (docs/protocol.md). This file does not depend on the messages. */
#ifndef HAPTIC_FRAME_H
#define HAPTIC_FRAME_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define HL_MAX_FRAME 175        /* longest frame of the protocol without its delimiter: INFO for eight axes */
#define HL_RESIDUE 0x2144DF1Cu  /* CRC-32 of any payload followed by its own CRC-32 */

/* Collects a frame; once the frame is complete, its payload begins at bytes[1]. */
typedef struct {
    uint8_t bytes[HL_MAX_FRAME], length;
    bool skipping; /* the frame is too long: drop all bytes up to the next delimiter */
} hl_receiver;

static inline uint8_t *hl_put16(uint8_t *p, uint16_t v)
{
    p[0] = (uint8_t)(v & 0xFFu);
    p[1] = (uint8_t)(v >> 8);
    return p + 2;
}

static inline uint8_t *hl_put32(uint8_t *p, uint32_t v)
{
    return hl_put16(hl_put16(p, (uint16_t)(v & 0xFFFFu)), (uint16_t)(v >> 16));
}

static inline uint16_t hl_get16(const uint8_t *p) { return (uint16_t)(p[0] | ((uint16_t)p[1] << 8)); }

static inline int16_t hl_signed(uint16_t v) { return (int16_t)(v < 0x8000u ? (int32_t)v : (int32_t)v - 0x10000); }

/* CRC-32 as in zlib and Ethernet, four bits at a time, with a table of 64 bytes. */
static inline uint32_t hl_crc(const uint8_t *p, size_t n)
{
    static const uint32_t table[16] = {0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u,
                                       0x4DB26158u, 0x5005713Cu, 0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu,
                                       0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    uint32_t crc = 0xFFFFFFFFu;
    while (n--) {
        crc ^= *p++;
        crc = (crc >> 4) ^ table[crc & 15u];
        crc = (crc >> 4) ^ table[crc & 15u];
    }
    return ~crc;
}

/* Turns the n payload bytes that begin at frame[1] into a frame with its final zero, in place, and returns its length, n + 6. */
static inline size_t hl_stuff(uint8_t *frame, size_t n)
{
    size_t code = 0, i;
    hl_put32(frame + 1 + n, hl_crc(frame + 1, n));
    n += 4;
    for (i = 1; i <= n; i++)
        if (frame[i] == 0) {
            frame[code] = (uint8_t)(i - code);
            code = i;
        }
    frame[code] = (uint8_t)(n + 1 - code);
    frame[n + 1] = 0;
    return n + 2;
}

/* Takes one byte from the wire. Returns the length of the payload that the byte completes, 0 if it completes none, or -1, once
 * for each frame that must be dropped. */
static inline int hl_collect(hl_receiver *r, uint8_t byte)
{
    size_t i = 0, n = r->length;
    if (byte != 0) {
        bool fits = n < HL_MAX_FRAME, dropped = !fits && !r->skipping;
        if (fits) r->bytes[r->length++] = byte;
        r->skipping = r->skipping || !fits;
        return dropped ? -1 : 0;
    }
    r->length = 0;
    if (r->skipping || n == 0) {
        r->skipping = false;
        return 0;
    }
    while (i < n) {
        uint8_t code = r->bytes[i];
        r->bytes[i] = 0;
        i += code;
    }
    if (i != n || n < 6 || hl_crc(r->bytes + 1, n - 1) != HL_RESIDUE) return -1;
    return (int)n - 5;
}

#endif
