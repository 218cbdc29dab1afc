/* Two small models as FMUs, for tests: a heated tank with a wall, and a ball that bounces.

   FMI is 2 or 3, and MODEL is 1 (tank) or 2 (ball). Both kinds are in one library: co-simulation
   integrates by the midpoint rule, in steps of its own, from step to step of communication. The
   functions of FMI that are not here fail: `fmu` adds them. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#if FMI == 2
#include "fmi2FunctionTypes.h"
#define fmi(name) fmi2##name
#define GET_NUMBERS fmi2GetReal
#define SET_NUMBERS fmi2SetReal
#define GET_RATES fmi2GetDerivatives
typedef fmi2ValueReference Reference;
typedef fmi2Boolean Boolean;
typedef fmi2CallbackLogger Logger;
#else
#include "fmi3FunctionTypes.h"
#define fmi(name) fmi3##name
#define GET_NUMBERS fmi3GetFloat64
#define SET_NUMBERS fmi3SetFloat64
#define GET_RATES fmi3GetContinuousStateDerivatives
typedef fmi3ValueReference Reference;
typedef fmi3Boolean Boolean;
typedef fmi3LogMessageCallback Logger;
#endif
enum { OK = 0, ERROR = 3 };

#if MODEL == 1
enum { TOKEN = 1, STATES = 2, INDICATORS = 0, VALUES = 11 };
enum { T, WALL, DT, DWALL, HEATER, AMBIENT, C, G, WALL_C, LOSS, START };
static const double START_VALUES[VALUES] = {300, 300, 0, 0, 0, 300, 4000, 50, 1000, 10, 0};
#else
enum { TOKEN = 2, STATES = 2, INDICATORS = 1, VALUES = 6 };
enum { H, V, DH, DV, E, GRAVITY };
static const double START_VALUES[VALUES] = {1, 0, 0, 0, 0.7, 9.81};
#endif

typedef struct {
    double v[VALUES], time, largest;
    void *environment;
    Logger log;
} Model;

static int instances = 0;

static int failed(Model *m, const char *text)
{
#if FMI == 2
    m->log(m->environment, "model", ERROR, "error", "%s", text);
#else
    m->log(m->environment, ERROR, "error", text);
#endif
    return ERROR;
}

static void rates(double *v)
{
#if MODEL == 1
    const double in = v[G] * (v[T] - v[WALL]);
    v[DT] = (v[HEATER] - in) / v[C];
    v[DWALL] = (in - v[LOSS] * (v[WALL] - v[AMBIENT])) / v[WALL_C];
#else
    v[DH] = v[V];
    v[DV] = -v[GRAVITY];
#endif
}

static int boils(Model *m)
{
#if MODEL == 1
    if (m->v[T] > 373.15) return failed(m, "the tank boils");
#endif
    return OK;
}

static void event(Model *m)
{
#if MODEL == 2
    if (m->v[H] <= 0 && m->v[V] < 0) {
        m->v[H] = 0;
        m->v[V] *= -m->v[E];
    }
#endif
}

static int step(Model *m, double from, double size)
{
    const int n = (int)ceil(size / m->largest - 1e-9);
    for (int k = 0; k < n; k++) {
        double half[VALUES];
        memcpy(half, m->v, sizeof half);
        rates(half);
        for (int i = 0; i < STATES; i++) half[i] += size / n / 2 * half[STATES + i];
        rates(half);
        for (int i = 0; i < STATES; i++) m->v[i] += size / n * half[STATES + i];
        event(m);
        if (boils(m)) return ERROR;
    }
    m->time = from + size;
    rates(m->v);
    return OK;
}

int fmi(Reset)(Model *m)
{
    memcpy(m->v, START_VALUES, sizeof m->v);
    m->time = 0;
    m->largest = MODEL == 1 ? 1e-2 : 1e-3;
    return OK;
}

static Model *made(const char *token, Logger log, void *environment)
{
    if (ONLY_ONE && instances > 0) return NULL;
    if (token[0] != '0' + TOKEN) return NULL;
    Model *m = calloc(1, sizeof(Model));
    instances++;
    fmi(Reset)(m);
    m->log = log;
    m->environment = environment;
    return m;
}

void fmi(FreeInstance)(Model *m)
{
    free(m);
    instances--;
}

int GET_NUMBERS(Model *m, const Reference *r, size_t n, double *value)
{
    rates(m->v);
    for (size_t i = 0; i < n; i++) value[i] = m->v[r[i]];
    return OK;
}

int SET_NUMBERS(Model *m, const Reference *r, size_t n, const double *value)
{
    for (size_t i = 0; i < n; i++) {
#if MODEL == 1
        if (r[i] == C && value[i] <= 0) return failed(m, "tank.C is not above 0");
#endif
        m->v[r[i]] = value[i];
    }
    return OK;
}

int fmi(ExitInitializationMode)(Model *m)
{
#if MODEL == 1
    if (m->v[START] > 0) m->v[WALL] = m->v[START];
#endif
    return OK;
}

int GET_RATES(Model *m, double *dx, size_t n)
{
    rates(m->v);
    memcpy(dx, m->v + STATES, n * sizeof *dx);
    return boils(m);
}

int fmi(SetTime)(Model *m, double t) { m->time = t; return OK; }
int fmi(SetContinuousStates)(Model *m, const double *x) { memcpy(m->v, x, STATES * sizeof *x); return OK; }
int fmi(GetContinuousStates)(Model *m, double *x) { memcpy(x, m->v, STATES * sizeof *x); return OK; }

int fmi(GetNominalsOfContinuousStates)(Model *m, double *x, size_t n)
{
    for (size_t i = 0; i < n; i++) x[i] = 1;
    return OK;
}

int fmi(GetEventIndicators)(Model *m, double *z, size_t n)
{
    for (size_t i = 0; i < n; i++) z[i] = m->v[0];
    return OK;
}

int fmi(CompletedIntegratorStep)(Model *m, Boolean last, Boolean *event_mode, Boolean *end)
{
    *event_mode = *end = 0;
    return OK;
}

int fmi(SetDebugLogging)() { return OK; }
int fmi(EnterInitializationMode)() { return OK; }
int fmi(EnterEventMode)() { return OK; }
int fmi(EnterContinuousTimeMode)() { return OK; }
int fmi(Terminate)() { return OK; }

#if FMI == 2
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
int fmi2SetupExperiment() { return OK; }
int fmi2DoStep(Model *m, double t, double h, Boolean keep) { return step(m, t, h); }

Model *fmi2Instantiate(const char *name, int kind, const char *token, const char *folder,
                       const fmi2CallbackFunctions *f, Boolean visible, Boolean logging)
{
    return made(token, f->logger, f->componentEnvironment);
}

int fmi2NewDiscreteStates(Model *m, fmi2EventInfo *info)
{
    memset(info, 0, sizeof *info);
    event(m);
    return OK;
}
#else
const char *fmi3GetVersion(void) { return "3.0"; }

Model *fmi3InstantiateModelExchange(const char *name, const char *token, const char *folder,
                                    Boolean visible, Boolean logging, void *environment, Logger log)
{
    return made(token, log, environment);
}

Model *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *folder,
                                   Boolean visible, Boolean logging, Boolean events, Boolean early,
                                   const Reference *r, size_t n, void *environment, Logger log)
{
    return made(token, log, environment);
}

int fmi3GetNumberOfEventIndicators(Model *m, size_t *n) { *n = INDICATORS; return OK; }
int fmi3GetNumberOfContinuousStates(Model *m, size_t *n) { *n = STATES; return OK; }

int fmi3UpdateDiscreteStates(Model *m, Boolean *again, Boolean *end, Boolean *nominals,
                             Boolean *values, Boolean *event_time, double *next)
{
    *again = *end = *nominals = *values = *event_time = 0;
    event(m);
    return OK;
}

int fmi3DoStep(Model *m, double t, double h, Boolean keep, Boolean *event_mode, Boolean *end,
               Boolean *early, double *last)
{
    *event_mode = *end = *early = 0;
    *last = t + h;
    return step(m, t, h);
}
#endif
