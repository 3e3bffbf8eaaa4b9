/* A monitor that stlc exported; `NAME` begins the names of its header. */
#include HEADER

#include "board.h"

#define JOINED(a, b) a##_##b
#define NAMED(a, b) JOINED(a, b)

static NAMED(NAME, state) state;

void monitor_begin(void) { NAMED(NAME, init)(&state); }
void monitor_take(const float *sample) { NAMED(NAME, step)(&state, sample); }
void monitor_end(uint32_t *known, uint32_t *satisfied) {
  NAMED(NAME, summary) found;
  NAMED(NAME, read)(&state, 0, &found);
  *known = (uint32_t)found.starts;
  *satisfied = (uint32_t)found.satisfied;
}
