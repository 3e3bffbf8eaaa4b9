/* A monitor on the board: `SIGNALS` numbers are a sample. */
#ifndef BOARD_H
#define BOARD_H
#include <stdint.h>

void monitor_begin(void);
void monitor_take(const float *sample);
/* Starts whose verdict is known, and how many of them are satisfied. */
void monitor_end(uint32_t *known, uint32_t *satisfied);
#endif
