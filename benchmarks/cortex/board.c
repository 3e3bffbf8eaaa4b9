/* Program that counts the instructions of a monitor on a Cortex-M4, as QEMU's board mps2-an386 runs it.

   With `-icount shift=0` an instruction takes a nanosecond of the board's time, and SysTick counts that time; a loop
   of known length tells how many instructions a tick is. The answer is printed by semihosting. */
#include "board.h"

#define ROWS 1000

extern uint32_t stack;
int main(void);

void reset(void) {
  *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the floating-point unit */
  main();
}
static void stop(void) { for (;;) {} }
__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    &stack, (const void *)reset, (const void *)stop, (const void *)stop, (const void *)stop, (const void *)stop, (const void *)stop};

static int host(int operation, const void *argument) {
  register int r0 __asm__("r0") = operation;
  register const void *r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}
static void print(uint32_t number, char after) {
  char text[12], *at = text + 11;
  *at = 0;
  *--at = after;
  do *--at = (char)('0' + number % 10); while (number /= 10);
  host(4, at);
}

static volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010; /* control, reload, current */
static uint32_t since(uint32_t before) { return (before - systick[2]) & 0xFFFFFF; }

static float table[ROWS][SIGNALS];

int main(void) {
  uint32_t ticks = 0, known = 0, satisfied = 0, seed = 1, loops = 1000000, before;
  systick[1] = 0xFFFFFF;
  systick[0] = 5;
  for (int k = 0; k < ROWS; ++k)
    for (int i = 0; i < SIGNALS; ++i) {
      seed = seed * 1664525u + 1013904223u;
      table[k][i] = (float)(10 * (seed >> 22)) / 1024.0f; /* from 0 to 10, the same in any precision */
    }
  before = systick[2];
  __asm__ volatile("1: subs %0, %0, #1\n bne 1b" : "+r"(loops) : : "cc");
  print(since(before), ' '); /* ticks of two million instructions */
  monitor_begin();
  for (int pass = 0; pass < PASSES; ++pass) {
    before = systick[2];
    for (int k = 0; k < ROWS; ++k) monitor_take(table[k]);
    if (pass >= FULL) ticks += since(before);
  }
  print(ticks, ' ');
  monitor_end(&known, &satisfied);
  print(known, ' ');
  print(satisfied, '\n');
  host(0x18, (const void *)0x20026);
  stop();
}
