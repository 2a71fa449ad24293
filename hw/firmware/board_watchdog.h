/* watchdogStart(ms) starts the board's own watchdog (15 or 30 ms on AVR), which resets the board if watchdogFeed() is not
 * called for this time. Without a watchdog, a loop that hangs keeps the last PWM for ever. After a reset the pins float, so a
 * pull-down keeps ENABLE low. */
#ifndef BOARD_WATCHDOG_H
#define BOARD_WATCHDOG_H

#include <stdint.h>

#if defined(__IMXRT1062__) /* Teensy 4: the RTWDOG of the i.MX RT1060, on its 32 kHz clock */
static inline void watchdogStart(uint32_t ms)
{
  CCM_CCGR5 |= CCM_CCGR5_WDOG3(3);
  noInterrupts();
  WDOG3_CNT = 0xD928C520u; /* unlock */
  while (!(WDOG3_CS & WDOG_CS_ULK)) {}
  WDOG3_TOVAL = ms * 32;
  WDOG3_WIN = 0;
  WDOG3_CS = WDOG_CS_EN | WDOG_CS_UPDATE | WDOG_CS_CLK(1) | WDOG_CS_CMD32EN;
  while (!(WDOG3_CS & WDOG_CS_RCS)) {}
  interrupts();
}
static inline void watchdogFeed() { WDOG3_CNT = 0xB480A602u; }
#elif defined(__AVR__)
#include <avr/wdt.h>
static inline void watchdogStart(uint32_t ms) { wdt_enable(ms > 15 ? WDTO_30MS : WDTO_15MS); }
static inline void watchdogFeed() { wdt_reset(); }
#elif defined(BOARD_WATCHDOG) /* your macro: BOARD_WATCHDOG(ms) starts the watchdog if ms > 0 and feeds it if ms is 0 */
static inline void watchdogStart(uint32_t ms) { BOARD_WATCHDOG(ms); }
static inline void watchdogFeed() { BOARD_WATCHDOG(0); }
#else
#error "no watchdog for this board: define BOARD_WATCHDOG (see above)"
#endif

#endif
