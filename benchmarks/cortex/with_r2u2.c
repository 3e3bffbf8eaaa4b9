/* A monitor of R2U2; `SPECIFICATION` is the file of its compiler's bytes, as numbers of C. */
#include "r2u2.h"

#include "board.h"

static uint8_t specification[] __attribute__((aligned(8))) = {
#include SPECIFICATION
};
static r2u2_monitor_t monitor = R2U2_DEFAULT_MONITOR;
static uint32_t next, held;

/* A verdict holds for all starts since the one before it. */
static r2u2_status_t told(r2u2_mltl_instruction_t instruction, r2u2_verdict *verdict) {
  const uint32_t after = get_verdict_time(*verdict) + 1;
  (void)instruction;
  if (get_verdict_truth(*verdict)) held += after - next;
  next = after;
  return R2U2_OK;
}

void monitor_begin(void) {
  r2u2_load_specification(specification, &monitor);
  monitor.out_func = told;
}
void monitor_take(const float *sample) {
  for (int i = 0; i < SIGNALS; ++i) r2u2_load_float_signal(&monitor, (size_t)i, sample[i]);
  r2u2_step(&monitor);
}
void monitor_end(uint32_t *known, uint32_t *satisfied) {
  *known = next;
  *satisfied = held;
}
