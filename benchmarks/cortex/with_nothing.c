/* The loop over samples alone, which is subtracted. */
#include "board.h"

void monitor_begin(void) {}
void monitor_take(const float *sample) { __asm__ volatile("" : : "r"(sample)); }
void monitor_end(uint32_t *known, uint32_t *satisfied) { *known = *satisfied = 0; }
