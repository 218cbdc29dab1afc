
/* The functions of FMI 2.0 for co-simulation, in plain types of C: a boolean or status is an int. */
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define RETURNS(status, name) EXPORT int name() { return status; }
#define NONE_OF(type, value) \
    EXPORT int fmi2Get##type(void *c, const unsigned r[], size_t n, value v[]) { return n ? 3 : 0; } \
    EXPORT int fmi2Set##type(void *c, const unsigned r[], size_t n, value v[]) { return n ? 3 : 0; }

typedef struct {
    void (*log)(void *, const char *, int, const char *, const char *, ...);
    void *memory_and_end[3], *environment;
} Callbacks;
typedef struct { double v[$size]; int is_stale; const Callbacks *callbacks; } Instance;
static const double start_values[$size] = {$start};

static void physics_of(const double *x, double *f_p)
{
$physics
}

static void update(double *v)
{
    const double read[] = {$read};
    if ($has_physics) physics_of(read, v + $f_p);
    $call;
    for (int i = $sd; i < $size; i++) v[i] = sqrt(v[i]);
}

static int failed(const Instance *c, const char *message)
{
    if (c->callbacks && c->callbacks->log)
        c->callbacks->log(c->callbacks->environment, "$name", 3, "logStatusError", message);
    return 3;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT int fmi2Reset(Instance *c)
{
    memcpy(c->v, start_values, sizeof c->v);
    c->is_stale = 1;
    return 0;
}
EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                             const Callbacks *callbacks, int visible, int logging)
{
    Instance *c = type == 1 && strcmp(guid, "$guid") == 0 ? calloc(1, sizeof *c) : NULL;
    if (c) fmi2Reset(c);
    if (c) c->callbacks = callbacks;
    return c;
}
EXPORT void fmi2FreeInstance(void *c) { free(c); }
EXPORT int fmi2GetReal(Instance *c, const unsigned r[], size_t n, double value[])
{
    if ($is_direct && c->is_stale) update(c->v);
    c->is_stale = 0;
    for (size_t i = 0; i < n; i++) value[i] = c->v[r[i]];
    return 0;
}
EXPORT int fmi2SetReal(Instance *c, const unsigned r[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++) {
        if (r[i] >= $settable) return failed(c, "A mean or standard deviation cannot be set.");
        c->v[r[i]] = value[i];
    }
    c->is_stale = 1;
    return 0;
}
EXPORT int fmi2DoStep(Instance *c, double t, double h, int is_final)
{
    if ($is_direct) return 0;
    if (fabs(h - $step) > 1e-9 * $step) return failed(c, "Expected a step of $step.");
    update(c->v);
    return 0;
}
EXPORT int fmi2GetFMUstate(Instance *c, Instance **state)
{
    if (!*state) *state = malloc(sizeof *c);
    if (*state) **state = *c;
    return *state ? 0 : 3;
}
EXPORT int fmi2SetFMUstate(Instance *c, const Instance *state) { *c = *state; return 0; }
EXPORT int fmi2FreeFMUstate(void *c, void **state) { free(*state); *state = NULL; return 0; }
NONE_OF(Integer, int)
NONE_OF(Boolean, int)
NONE_OF(String, const char *)
RETURNS(0, fmi2SetDebugLogging)
RETURNS(0, fmi2SetupExperiment)
RETURNS(0, fmi2EnterInitializationMode)
RETURNS(0, fmi2ExitInitializationMode)
RETURNS(0, fmi2Terminate)
/* Optional, and not there by modelDescription.xml. */
RETURNS(3, fmi2SetRealInputDerivatives)
RETURNS(3, fmi2GetRealOutputDerivatives)
RETURNS(3, fmi2GetDirectionalDerivative)
RETURNS(3, fmi2SerializedFMUstateSize)
RETURNS(3, fmi2SerializeFMUstate)
RETURNS(3, fmi2DeSerializeFMUstate)
RETURNS(3, fmi2CancelStep)
RETURNS(3, fmi2GetStatus)
RETURNS(3, fmi2GetRealStatus)
RETURNS(3, fmi2GetIntegerStatus)
RETURNS(3, fmi2GetBooleanStatus)
RETURNS(3, fmi2GetStringStatus)
