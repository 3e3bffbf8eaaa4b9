/* Three models as FMUs, for FMI 2 and FMI 3 (-DFMI=2 or 3), for co-simulation and model exchange:
 * a bouncing ball (-DMODEL=1), x' = -k x (-DMODEL=2), and the oscillator of van der Pol (-DMODEL=3).
 * Functions of the standards that are not used here are in stubs.h, which the tests write. */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SAME 1e-12
#define MICRO 1e-3
#define SLOW 0.05

typedef unsigned int Ref;
enum { OK = 0, WARNING = 1, DISCARD = 2, ERROR = 3 };

#if FMI == 2
typedef int Flag;
#else
typedef bool Flag;
#endif

typedef struct {
    double time, x[2], input, param[2], lifetime;
    int bounces;
    Flag frozen, resting, ended, exchange;
} Model;

#if MODEL == 1
enum { STATES = 2, EVENTS = 1 };

static void begin(Model *m) { m->x[0] = 1.0; m->param[0] = 9.81; m->param[1] = 0.7; }

static void slope(const Model *m, double *dx) {
    bool still = m->frozen || m->resting;
    dx[0] = still ? 0.0 : m->x[1];
    dx[1] = still ? 0.0 : m->input - m->param[0];
}

static double indicator(const Model *m) { return m->resting ? 1.0 : m->x[0]; }

static bool event(Model *m) {
    if (m->x[0] > 0.0 || m->x[1] >= 0.0) return false;
    m->x[0] = SAME;
    m->x[1] = -m->param[1] * m->x[1];
    m->bounces += 1;
    if (m->x[1] < SLOW) {
        m->resting = true;
        m->x[0] = m->x[1] = 0.0;
    }
    return true;
}
#elif MODEL == 2
enum { STATES = 1, EVENTS = 0 };

static void begin(Model *m) { m->x[0] = 1.0; m->param[0] = 1.0; }

static void slope(const Model *m, double *dx) { dx[0] = -m->param[0] * m->x[0] + m->input; }

static double indicator(const Model *m) { (void)m; return 1.0; }

static bool event(Model *m) { (void)m; return false; }
#else
enum { STATES = 2, EVENTS = 0 };

static void begin(Model *m) { m->x[0] = 2.0; m->param[0] = 1.0; }

static void slope(const Model *m, double *dx) {
    dx[0] = m->x[1];
    dx[1] = m->param[0] * (1.0 - m->x[0] * m->x[0]) * m->x[1] - m->x[0] + m->input;
}

static double indicator(const Model *m) { (void)m; return 1.0; }

static bool event(Model *m) { (void)m; return false; }
#endif

static void move(Model *m, double h) {
    double k[4][2], x[2];
    memcpy(x, m->x, sizeof x);
    for (int s = 0; s < 4; s++) {
        double part = s == 0 ? 0.0 : s == 3 ? h : h / 2;
        for (int i = 0; i < STATES; i++) m->x[i] = x[i] + (s ? part * k[s - 1][i] : 0.0);
        slope(m, k[s]);
    }
    for (int i = 0; i < STATES; i++)
        m->x[i] = x[i] + h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
    m->time += h;
}

/* One small step, shortened by bisection to where the indicator changes its sign. */
static void step(Model *m, double h) {
    Model before = *m;
    move(m, h);
    if (!EVENTS || indicator(m) > 0.0) return;
    double low = 0.0, high = h;
    for (int i = 0; i < 60; i++) {
        double middle = (low + high) / 2;
        *m = before;
        move(m, middle);
        if (indicator(m) > 0.0) low = middle; else high = middle;
    }
    *m = before;
    move(m, high);
    event(m);
}

static int advance(Model *m, double until) {
    while (m->time < until - SAME) {
        if (m->time >= m->lifetime) { m->ended = true; return DISCARD; }
        step(m, fmin(MICRO, until - m->time));
    }
    return OK;
}

/* ------------------------------------------------------------------------ variables */

static double *real(Model *m, Ref ref, double *room) {
    double dx[2] = {0, 0};
    slope(m, dx);
    switch (ref) {
    case 0: return &m->time;
    case 1: return &m->x[0];
    case 2: return &m->x[1];
    case 3: *room = dx[0]; return room;
    case 4: *room = dx[1]; return room;
    case 5: return &m->param[0];
    case 6: return &m->param[1];
    case 7: return &m->input;
    case 8: return &m->lifetime;
    default: return NULL;
    }
}

static int get_reals(Model *m, const Ref *refs, size_t n, double *values) {
    double room;
    for (size_t i = 0; i < n; i++) {
        double *found = real(m, refs[i], &room);
        if (!found) return ERROR;
        values[i] = *found;
    }
    return OK;
}

static int set_reals(Model *m, const Ref *refs, size_t n, const double *values) {
    double room;
    for (size_t i = 0; i < n; i++) {
        double *found = real(m, refs[i], &room);
        if (!found || found == &room || refs[i] == 0) return ERROR;
        *found = values[i];
    }
    return OK;
}

static int get_ints(Model *m, size_t n, int *values) {
    for (size_t i = 0; i < n; i++) values[i] = m->bounces;
    return OK;
}

static int set_flags(Model *m, size_t n, const Flag *values) {
    for (size_t i = 0; i < n; i++) m->frozen = values[i];
    return OK;
}

static Model *made(bool exchange) {
    Model *m = calloc(1, sizeof(Model));
    m->lifetime = 1e300;
    m->exchange = exchange;
    begin(m);
    printf("a plant may print\n");
    return m;
}

static int get_x(Model *m, double *x, size_t n) { memcpy(x, m->x, n * sizeof *x); return OK; }
static int set_x(Model *m, const double *x, size_t n) { memcpy(m->x, x, n * sizeof *x); return OK; }
static int get_dx(Model *m, double *dx, size_t n) { (void)n; slope(m, dx); return OK; }
static int get_z(Model *m, double *z, size_t n) { if (n) z[0] = indicator(m); return OK; }
static int nominals(double *x, size_t n) { for (size_t i = 0; i < n; i++) x[i] = 1.0; return OK; }

/* ---------------------------------------------------------------------- the standards */

#if FMI == 2
typedef struct { int again, ends, nominals, values, timed; double time; } EventInfo;

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
void *fmi2Instantiate(const char *name, int kind, const char *guid, const char *resources, const void *callbacks,
                      int visible, int logging) {
    (void)name; (void)resources; (void)callbacks; (void)visible; (void)logging;
    return strcmp(guid, "stlc") == 0 ? made(kind == 0) : NULL;
}
void fmi2FreeInstance(void *m) { free(m); }
int fmi2SetupExperiment(void *m, int given, double tolerance, double start, int stops, double stop) {
    (void)given; (void)tolerance; (void)stops; (void)stop;
    ((Model *)m)->time = start;
    return OK;
}
int fmi2EnterInitializationMode(void *m) { (void)m; return OK; }
int fmi2ExitInitializationMode(void *m) { (void)m; return OK; }
int fmi2Terminate(void *m) { (void)m; return OK; }
int fmi2GetReal(void *m, const Ref *refs, size_t n, double *values) { return get_reals(m, refs, n, values); }
int fmi2SetReal(void *m, const Ref *refs, size_t n, const double *values) { return set_reals(m, refs, n, values); }
int fmi2GetInteger(void *m, const Ref *refs, size_t n, int *values) { (void)refs; return get_ints(m, n, values); }
int fmi2SetBoolean(void *m, const Ref *refs, size_t n, const int *values) { (void)refs; return set_flags(m, n, values); }
int fmi2DoStep(void *m, double t, double h, int keep) { (void)keep; return advance(m, t + h); }
int fmi2GetBooleanStatus(void *m, int kind, int *value) { (void)kind; *value = ((Model *)m)->ended; return OK; }
int fmi2EnterEventMode(void *m) { (void)m; return OK; }
int fmi2EnterContinuousTimeMode(void *m) { (void)m; return OK; }
int fmi2NewDiscreteStates(void *m, EventInfo *info) {
    memset(info, 0, sizeof *info);
    info->values = event(m);
    return OK;
}
int fmi2CompletedIntegratorStep(void *m, int keep, int *enter, int *ends) {
    (void)keep;
    *enter = 0;
    *ends = ((Model *)m)->time >= ((Model *)m)->lifetime;
    return OK;
}
int fmi2SetTime(void *m, double t) { ((Model *)m)->time = t; return OK; }
int fmi2GetContinuousStates(void *m, double *x, size_t n) { return get_x(m, x, n); }
int fmi2SetContinuousStates(void *m, const double *x, size_t n) { return set_x(m, x, n); }
int fmi2GetDerivatives(void *m, double *dx, size_t n) { return get_dx(m, dx, n); }
int fmi2GetEventIndicators(void *m, double *z, size_t n) { return get_z(m, z, n); }
int fmi2GetNominalsOfContinuousStates(void *m, double *x, size_t n) { (void)m; return nominals(x, n); }
#else
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool visible,
                                   bool logging, void *environment, void *log) {
    (void)name; (void)resources; (void)visible; (void)logging; (void)environment; (void)log;
    return strcmp(token, "stlc") == 0 ? made(true) : NULL;
}
void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                  bool logging, bool events, bool early, const Ref *refs, size_t n,
                                  void *environment, void *log, void *update) {
    (void)name; (void)resources; (void)visible; (void)logging; (void)events; (void)early; (void)refs; (void)n;
    (void)environment; (void)log; (void)update;
    return strcmp(token, "stlc") == 0 ? made(false) : NULL;
}
void fmi3FreeInstance(void *m) { free(m); }
int fmi3EnterInitializationMode(void *m, bool given, double tolerance, double start, bool stops, double stop) {
    (void)given; (void)tolerance; (void)stops; (void)stop;
    ((Model *)m)->time = start;
    return OK;
}
int fmi3ExitInitializationMode(void *m) { (void)m; return OK; }
int fmi3Terminate(void *m) { (void)m; return OK; }
int fmi3GetFloat64(void *m, const Ref *refs, size_t n, double *values, size_t k) { (void)k; return get_reals(m, refs, n, values); }
int fmi3SetFloat64(void *m, const Ref *refs, size_t n, const double *values, size_t k) { (void)k; return set_reals(m, refs, n, values); }
int fmi3GetInt32(void *m, const Ref *refs, size_t n, int *values, size_t k) { (void)refs; (void)k; return get_ints(m, n, values); }
int fmi3SetBoolean(void *m, const Ref *refs, size_t n, const bool *values, size_t k) { (void)refs; (void)k; return set_flags(m, n, values); }
int fmi3DoStep(void *m, double t, double h, bool keep, bool *event_needed, bool *ends, bool *early, double *last) {
    (void)keep;
    *event_needed = *early = false;
    *ends = advance(m, t + h) == DISCARD;
    *last = ((Model *)m)->time;
    return OK;
}
int fmi3EnterEventMode(void *m) { (void)m; return OK; }
int fmi3EnterContinuousTimeMode(void *m) { (void)m; return OK; }
int fmi3UpdateDiscreteStates(void *m, bool *again, bool *ends, bool *nominal, bool *values, bool *timed, double *t) {
    *again = *ends = *nominal = *timed = false;
    *t = 0.0;
    *values = event(m);
    return OK;
}
int fmi3CompletedIntegratorStep(void *m, bool keep, bool *enter, bool *ends) {
    (void)keep;
    *enter = false;
    *ends = ((Model *)m)->time >= ((Model *)m)->lifetime;
    return OK;
}
int fmi3SetTime(void *m, double t) { ((Model *)m)->time = t; return OK; }
int fmi3GetContinuousStates(void *m, double *x, size_t n) { return get_x(m, x, n); }
int fmi3SetContinuousStates(void *m, const double *x, size_t n) { return set_x(m, x, n); }
int fmi3GetContinuousStateDerivatives(void *m, double *dx, size_t n) { return get_dx(m, dx, n); }
int fmi3GetEventIndicators(void *m, double *z, size_t n) { return get_z(m, z, n); }
int fmi3GetNominalsOfContinuousStates(void *m, double *x, size_t n) { (void)m; return nominals(x, n); }
#endif

#include "stubs.h"
