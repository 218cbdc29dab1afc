/* Two small models as FMUs, for tests: a heated tank with a wall, and a ball that bounces.

   FMI is 2 or 3, and MODEL is 1 (tank) or 2 (ball). Both kinds are in one library: co-simulation
   integrates by the midpoint rule, in steps of its own, from step to step of communication. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if FMI == 2
#include "fmi2Functions.h"
#define STATUS fmi2Status
#define OK fmi2OK
#define ERROR fmi2Error
#define COMPONENT fmi2Component
typedef unsigned int Reference;
#else
#include "fmi3Functions.h"
#define STATUS fmi3Status
#define OK fmi3OK
#define ERROR fmi3Error
#define COMPONENT fmi3Instance
typedef fmi3ValueReference Reference;
#endif

#if MODEL == 1
enum { TOKEN = 1, STATES = 2, INDICATORS = 0, VALUES = 12 };
enum { T, WALL, DT, DWALL, HEATER, AMBIENT, C, G, WALL_C, LOSS, START, WALLS };
static const double START_VALUES[VALUES] = {300, 300, 0, 0, 0, 300, 4000, 50, 1000, 10, 0, 1};
#else
enum { TOKEN = 2, STATES = 2, INDICATORS = 1, VALUES = 6 };
enum { H, V, DH, DV, E, GRAVITY };
static const double START_VALUES[VALUES] = {1, 0, 0, 0, 0.7, 9.81};
#endif

typedef struct {
    double v[VALUES], time, largest;
    void *environment;
#if FMI == 2
    fmi2CallbackLogger log;
#else
    fmi3LogMessageCallback log;
#endif
} Model;

static int instances = 0;

static STATUS failed(Model *m, const char *text)
{
#if FMI == 2
    m->log(m->environment, "model", fmi2Error, "error", "%s", text);
#else
    m->log(m->environment, fmi3Error, "error", text);
#endif
    return ERROR;
}

static void rates(double *v)
{
#if MODEL == 1
    const double in = v[WALLS] * v[G] * (v[T] - v[WALL]);
    v[DT] = (v[HEATER] - in) / v[C];
    v[DWALL] = (in - v[LOSS] * (v[WALL] - v[AMBIENT])) / v[WALL_C];
#else
    v[DH] = v[V];
    v[DV] = -v[GRAVITY];
#endif
}

static void event(Model *m)
{
#if MODEL == 2
    if (m->v[H] <= 0 && m->v[V] < 0) {
        m->v[H] = 0;
        m->v[V] *= -m->v[E];
    }
#else
    (void)m;
#endif
}

static STATUS step(Model *m, double from, double size)
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
#if MODEL == 1
        if (m->v[T] > 373.15) return failed(m, "the tank boils");
#endif
    }
    m->time = from + size;
    rates(m->v);
    return OK;
}

static void restart(Model *m)
{
    memcpy(m->v, START_VALUES, sizeof m->v);
    m->time = 0;
    m->largest = MODEL == 1 ? 1e-2 : 1e-3;
}

static Model *made(const char *token)
{
    if (ONLY_ONE && instances > 0) return NULL;
    if (token[0] != '0' + TOKEN) return NULL;
    Model *m = calloc(1, sizeof(Model));
    instances++;
    restart(m);
    return m;
}

static STATUS get(Model *m, const Reference *r, size_t n, double *value)
{
    rates(m->v);
    for (size_t i = 0; i < n; i++) value[i] = m->v[r[i]];
    return OK;
}

static STATUS derivatives(Model *m, double *dx, size_t n)
{
#if MODEL == 1
    if (m->v[T] > 373.15) return failed(m, "the tank boils");
#endif
    rates(m->v);
    memcpy(dx, m->v + STATES, n * sizeof *dx);
    return OK;
}

static STATUS set(Model *m, const Reference *r, size_t n, const double *value)
{
    for (size_t i = 0; i < n; i++) {
#if MODEL == 1
        if (r[i] == C && value[i] <= 0) return failed(m, "tank.C is not above 0");
#endif
        m->v[r[i]] = value[i];
    }
    return OK;
}

static STATUS get_whole(Model *m, const Reference *r, size_t n, int *value)
{
    for (size_t i = 0; i < n; i++) value[i] = (int)m->v[r[i]];
    return OK;
}

static STATUS set_whole(Model *m, const Reference *r, size_t n, const int *value)
{
    for (size_t i = 0; i < n; i++) m->v[r[i]] = value[i];
    return OK;
}

static STATUS begun(Model *m)
{
#if MODEL == 1
    if (m->v[START] > 0) m->v[WALL] = m->v[START];
#endif
    return OK;
}

#if FMI == 2
#define NONE(name, ...) fmi2Status name(__VA_ARGS__) { return fmi2Error; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String k[]) { return fmi2OK; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String folder,
                              const fmi2CallbackFunctions *f, fmi2Boolean visible, fmi2Boolean logging)
{
    Model *m = made(token);
    if (m) {
        m->log = f->logger;
        m->environment = f->componentEnvironment;
    }
    return m;
}
void fmi2FreeInstance(fmi2Component c) { free(c); instances--; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real t, fmi2Real a, fmi2Boolean s, fmi2Real b) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return begun(c); }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { restart(c); return fmi2OK; }
fmi2Status fmi2GetReal(fmi2Component c, const Reference r[], size_t n, fmi2Real v[]) { return get(c, r, n, v); }
fmi2Status fmi2SetReal(fmi2Component c, const Reference r[], size_t n, const fmi2Real v[]) { return set(c, r, n, v); }
fmi2Status fmi2GetInteger(fmi2Component c, const Reference r[], size_t n, fmi2Integer v[]) { return get_whole(c, r, n, v); }
NONE(fmi2GetBoolean, fmi2Component c, const Reference r[], size_t n, fmi2Boolean v[])
NONE(fmi2GetString, fmi2Component c, const Reference r[], size_t n, fmi2String v[])
fmi2Status fmi2SetInteger(fmi2Component c, const Reference r[], size_t n, const fmi2Integer v[]) { return set_whole(c, r, n, v); }
NONE(fmi2SetBoolean, fmi2Component c, const Reference r[], size_t n, const fmi2Boolean v[])
NONE(fmi2SetString, fmi2Component c, const Reference r[], size_t n, const fmi2String v[])
NONE(fmi2GetFMUstate, fmi2Component c, fmi2FMUstate *s)
NONE(fmi2SetFMUstate, fmi2Component c, fmi2FMUstate s)
NONE(fmi2FreeFMUstate, fmi2Component c, fmi2FMUstate *s)
NONE(fmi2SerializedFMUstateSize, fmi2Component c, fmi2FMUstate s, size_t *n)
NONE(fmi2SerializeFMUstate, fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n)
NONE(fmi2DeSerializeFMUstate, fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
NONE(fmi2GetDirectionalDerivative, fmi2Component c, const Reference u[], size_t n, const Reference k[], size_t o, const fmi2Real a[], fmi2Real b[])
fmi2Status fmi2EnterEventMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    memset(info, 0, sizeof *info);
    event(c);
    return fmi2OK;
}
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean p, fmi2Boolean *e, fmi2Boolean *t) { *e = *t = 0; return fmi2OK; }
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) { ((Model *)c)->time = t; return fmi2OK; }
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) { memcpy(((Model *)c)->v, x, n * sizeof *x); return fmi2OK; }
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) { return derivatives(c, dx, n); }
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) { for (size_t i = 0; i < n; i++) z[i] = ((Model *)c)->v[0]; return fmi2OK; }
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) { memcpy(x, ((Model *)c)->v, n * sizeof *x); return fmi2OK; }
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) { for (size_t i = 0; i < n; i++) x[i] = 1; return fmi2OK; }
NONE(fmi2SetRealInputDerivatives, fmi2Component c, const Reference r[], size_t n, const fmi2Integer o[], const fmi2Real v[])
NONE(fmi2GetRealOutputDerivatives, fmi2Component c, const Reference r[], size_t n, const fmi2Integer o[], fmi2Real v[])
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean p) { return step(c, t, h); }
NONE(fmi2CancelStep, fmi2Component c)
NONE(fmi2GetStatus, fmi2Component c, const fmi2StatusKind s, fmi2Status *v)
NONE(fmi2GetRealStatus, fmi2Component c, const fmi2StatusKind s, fmi2Real *v)
NONE(fmi2GetIntegerStatus, fmi2Component c, const fmi2StatusKind s, fmi2Integer *v)
NONE(fmi2GetBooleanStatus, fmi2Component c, const fmi2StatusKind s, fmi2Boolean *v)
NONE(fmi2GetStringStatus, fmi2Component c, const fmi2StatusKind s, fmi2String *v)
#else
#define NONE(name, ...) fmi3Status name(__VA_ARGS__) { return fmi3Error; }
#define PAIR(type) \
    NONE(fmi3Get##type, fmi3Instance c, const Reference r[], size_t n, fmi3##type v[], size_t k) \
    NONE(fmi3Set##type, fmi3Instance c, const Reference r[], size_t n, const fmi3##type v[], size_t k)
const char *fmi3GetVersion(void) { return "3.0"; }
fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String k[]) { return fmi3OK; }
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String folder, fmi3Boolean visible, fmi3Boolean logging, fmi3InstanceEnvironment e, fmi3LogMessageCallback log)
{
    Model *m = made(token);
    if (m) {
        m->log = log;
        m->environment = e;
    }
    return m;
}
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String folder, fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const Reference r[], size_t n, fmi3InstanceEnvironment e, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    return fmi3InstantiateModelExchange(name, token, folder, visible, logging, e, log);
}
fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String folder, fmi3Boolean visible, fmi3Boolean logging, fmi3InstanceEnvironment e, fmi3LogMessageCallback log, fmi3ClockUpdateCallback u, fmi3LockPreemptionCallback l, fmi3UnlockPreemptionCallback k) { return NULL; }
void fmi3FreeInstance(fmi3Instance c) { free(c); instances--; }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 t, fmi3Float64 a, fmi3Boolean s, fmi3Float64 b) { return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return begun(c); }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { restart(c); return fmi3OK; }
fmi3Status fmi3GetFloat64(fmi3Instance c, const Reference r[], size_t n, fmi3Float64 v[], size_t k) { return get(c, r, n, v); }
fmi3Status fmi3SetFloat64(fmi3Instance c, const Reference r[], size_t n, const fmi3Float64 v[], size_t k) { return set(c, r, n, v); }
fmi3Status fmi3GetInt32(fmi3Instance c, const Reference r[], size_t n, fmi3Int32 v[], size_t k) { return get_whole(c, r, n, v); }
fmi3Status fmi3SetInt32(fmi3Instance c, const Reference r[], size_t n, const fmi3Int32 v[], size_t k) { return set_whole(c, r, n, v); }
PAIR(Float32) PAIR(Int8) PAIR(UInt8) PAIR(Int16) PAIR(UInt16) PAIR(UInt32) PAIR(Int64) PAIR(UInt64) PAIR(Boolean) PAIR(String)
NONE(fmi3GetBinary, fmi3Instance c, const Reference r[], size_t n, size_t s[], fmi3Binary v[], size_t k)
NONE(fmi3SetBinary, fmi3Instance c, const Reference r[], size_t n, const size_t s[], const fmi3Binary v[], size_t k)
NONE(fmi3GetClock, fmi3Instance c, const Reference r[], size_t n, fmi3Clock v[])
NONE(fmi3SetClock, fmi3Instance c, const Reference r[], size_t n, const fmi3Clock v[])
NONE(fmi3GetNumberOfVariableDependencies, fmi3Instance c, Reference r, size_t *n)
NONE(fmi3GetVariableDependencies, fmi3Instance c, Reference r, size_t a[], Reference i[], size_t b[], fmi3DependencyKind k[], size_t n)
NONE(fmi3GetFMUState, fmi3Instance c, fmi3FMUState *s)
NONE(fmi3SetFMUState, fmi3Instance c, fmi3FMUState s)
NONE(fmi3FreeFMUState, fmi3Instance c, fmi3FMUState *s)
NONE(fmi3SerializedFMUStateSize, fmi3Instance c, fmi3FMUState s, size_t *n)
NONE(fmi3SerializeFMUState, fmi3Instance c, fmi3FMUState s, fmi3Byte b[], size_t n)
NONE(fmi3DeserializeFMUState, fmi3Instance c, const fmi3Byte b[], size_t n, fmi3FMUState *s)
NONE(fmi3GetDirectionalDerivative, fmi3Instance c, const Reference u[], size_t a, const Reference k[], size_t b, const fmi3Float64 s[], size_t d, fmi3Float64 e[], size_t f)
NONE(fmi3GetAdjointDerivative, fmi3Instance c, const Reference u[], size_t a, const Reference k[], size_t b, const fmi3Float64 s[], size_t d, fmi3Float64 e[], size_t f)
NONE(fmi3EnterConfigurationMode, fmi3Instance c)
NONE(fmi3ExitConfigurationMode, fmi3Instance c)
NONE(fmi3GetIntervalDecimal, fmi3Instance c, const Reference r[], size_t n, fmi3Float64 i[], fmi3IntervalQualifier q[])
NONE(fmi3GetIntervalFraction, fmi3Instance c, const Reference r[], size_t n, fmi3UInt64 i[], fmi3UInt64 s[], fmi3IntervalQualifier q[])
NONE(fmi3GetShiftDecimal, fmi3Instance c, const Reference r[], size_t n, fmi3Float64 s[])
NONE(fmi3GetShiftFraction, fmi3Instance c, const Reference r[], size_t n, fmi3UInt64 s[], fmi3UInt64 q[])
NONE(fmi3SetIntervalDecimal, fmi3Instance c, const Reference r[], size_t n, const fmi3Float64 i[])
NONE(fmi3SetIntervalFraction, fmi3Instance c, const Reference r[], size_t n, const fmi3UInt64 i[], const fmi3UInt64 s[])
NONE(fmi3SetShiftDecimal, fmi3Instance c, const Reference r[], size_t n, const fmi3Float64 s[])
NONE(fmi3SetShiftFraction, fmi3Instance c, const Reference r[], size_t n, const fmi3UInt64 s[], const fmi3UInt64 q[])
NONE(fmi3EvaluateDiscreteStates, fmi3Instance c)
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d, fmi3Boolean *e, fmi3Boolean *f, fmi3Float64 *t)
{
    *a = *b = *d = *e = *f = 0;
    event(c);
    return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean p, fmi3Boolean *e, fmi3Boolean *t) { *e = *t = 0; return fmi3OK; }
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { ((Model *)c)->time = t; return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) { memcpy(((Model *)c)->v, x, n * sizeof *x); return fmi3OK; }
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) { return derivatives(c, dx, n); }
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) { for (size_t i = 0; i < n; i++) z[i] = ((Model *)c)->v[0]; return fmi3OK; }
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { memcpy(x, ((Model *)c)->v, n * sizeof *x); return fmi3OK; }
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { for (size_t i = 0; i < n; i++) x[i] = 1; return fmi3OK; }
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { *n = INDICATORS; return fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { *n = STATES; return fmi3OK; }
NONE(fmi3EnterStepMode, fmi3Instance c)
NONE(fmi3GetOutputDerivatives, fmi3Instance c, const Reference r[], size_t n, const fmi3Int32 o[], fmi3Float64 v[], size_t k)
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean p, fmi3Boolean *event, fmi3Boolean *end, fmi3Boolean *early, fmi3Float64 *last)
{
    *event = *end = *early = 0;
    *last = t + h;
    return step(c, t, h);
}
NONE(fmi3ActivateModelPartition, fmi3Instance c, Reference r, fmi3Float64 t)
#endif
