/* {{ name }}.c as an FMU 2.0 for co-simulation. */
#include "{{ name }}.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { NX = {{ NAME }}_NX, NU = {{ NAME }}_NU, NY = {{ NAME }}_NY };

/* Value references: the inputs, the outputs, the states. */
enum { FIRST_Y = NU, FIRST_X = NU + NY, END = NU + NY + NX };

/* The binary interface of FMI 2.0, as far as it is used. */
typedef enum { OK, WARNING, DISCARD, ERROR } Status;

typedef struct {
    void (*logger)(void *environment, const char *instance, Status status, const char *category,
        const char *message, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, Status status);
    void *environment;
} Callbacks;

enum { CO_SIMULATION = 1 };

static const char guid[] = "{{ guid }}";
static const double u_start[NU] = { {{- u_start | join(", ") -}} };

typedef struct {
    double x[NX];
    double u[NU];
    const Callbacks *callbacks;
} Instance;

static Status failed(const Callbacks *callbacks, const char *message)
{
    if (callbacks && callbacks->logger)
        callbacks->logger(callbacks->environment, "{{ name }}", ERROR, "error", message);
    return ERROR;
}

static Status unsupported(void *c)
{
    const Instance *i = c;
    return failed(i->callbacks, "{{ name }} has real variables alone, and no such function");
}

const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

const char *fmi2GetVersion(void)
{
    return "2.0";
}

Status fmi2SetDebugLogging(void *c, int on, size_t count, const char *const categories[])
{
    (void)c, (void)on, (void)count, (void)categories;
    return OK;
}

Status fmi2Reset(void *c)
{
    Instance *i = c;
    {{ name }}_reset(i->x);
    memcpy(i->u, u_start, sizeof u_start);
    return OK;
}

void *fmi2Instantiate(const char *name, int type, const char *found, const char *resources,
    const Callbacks *callbacks, int visible, int logging)
{
    (void)name, (void)resources, (void)visible, (void)logging;
    if (type != CO_SIMULATION || !found || strcmp(found, guid)) {
        failed(callbacks, "{{ name }} is for co-simulation, with the GUID of its description");
        return NULL;
    }
    Instance *i = malloc(sizeof *i);
    if (!i)
        return NULL;
    i->callbacks = callbacks;
    fmi2Reset(i);
    return i;
}

void fmi2FreeInstance(void *c)
{
    free(c);
}

Status fmi2SetupExperiment(void *c, int tolerance_given, double tolerance, double start,
    int stop_given, double stop)
{
    (void)c, (void)tolerance_given, (void)tolerance, (void)start, (void)stop_given, (void)stop;
    return OK;
}

Status fmi2EnterInitializationMode(void *c)
{
    (void)c;
    return OK;
}

Status fmi2ExitInitializationMode(void *c)
{
    (void)c;
    return OK;
}

Status fmi2Terminate(void *c)
{
    (void)c;
    return OK;
}

/* The outputs are those of the state and the inputs at the time of the call. */
Status fmi2GetReal(void *c, const unsigned references[], size_t count, double values[])
{
    const Instance *i = c;
    double next[NX], y[NY];
    {{ name }}_step(i->x, i->u, next, y);
    for (size_t k = 0; k < count; k++) {
        unsigned r = references[k];
        if (r >= END)
            return failed(i->callbacks, "{{ name }} has no such real variable");
        values[k] = r < FIRST_Y ? i->u[r] : r < FIRST_X ? y[r - FIRST_Y] : i->x[r - FIRST_X];
    }
    return OK;
}

Status fmi2SetReal(void *c, const unsigned references[], size_t count, const double values[])
{
    Instance *i = c;
    for (size_t k = 0; k < count; k++) {
        unsigned r = references[k];
        if (r < FIRST_Y)
            i->u[r] = values[k];
        else if (r >= FIRST_X && r < END)
            i->x[r - FIRST_X] = values[k];
        else
            return failed(i->callbacks, "{{ name }}: inputs and states can be set, outputs cannot");
    }
    return OK;
}

/* One sample or several, with the inputs held. */
Status fmi2DoStep(void *c, double time, double size, int no_return)
{
    Instance *i = c;
    double y[NY], samples = floor(size / {{ NAME }}_TS + 0.5);
    (void)time, (void)no_return;
    if (!(samples >= 1.0) || fabs(size / {{ NAME }}_TS - samples) > 1e-6 * samples)
        return failed(i->callbacks, "{{ name }}: a step is a whole number of samples of {{ ts }} s");
    for (; samples > 0.0; samples--)
        {{ name }}_step(i->x, i->u, i->x, y);
    return OK;
}

Status fmi2CancelStep(void *c)
{
    return unsupported(c);
}
{% for kind, type in (("Integer", "int"), ("Boolean", "int"), ("String", "const char *")) %}

Status fmi2Get{{ kind }}(void *c, const unsigned references[], size_t count,
    {{ type }} values[])
{
    (void)references, (void)values;
    return count ? unsupported(c) : OK;
}

Status fmi2Set{{ kind }}(void *c, const unsigned references[], size_t count,
    {{ type }} const values[])
{
    (void)references, (void)values;
    return count ? unsupported(c) : OK;
}
{% endfor %}
{% for kind, type in (("", "Status"), ("Real", "double"), ("Integer", "int"), ("Boolean", "int"), ("String", "const char *")) %}

Status fmi2Get{{ kind }}Status(void *c, int what, {{ type }} *value)
{
    (void)what, (void)value;
    return unsupported(c);
}
{% endfor %}

Status fmi2SetRealInputDerivatives(void *c, const unsigned references[], size_t count,
    const int orders[], const double values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return unsupported(c);
}

Status fmi2GetRealOutputDerivatives(void *c, const unsigned references[], size_t count,
    const int orders[], double values[])
{
    (void)references, (void)count, (void)orders, (void)values;
    return unsupported(c);
}

Status fmi2GetDirectionalDerivative(void *c, const unsigned unknowns[], size_t unknown_count,
    const unsigned knowns[], size_t known_count, const double seeds[], double values[])
{
    (void)unknowns, (void)unknown_count, (void)knowns, (void)known_count, (void)seeds, (void)values;
    return unsupported(c);
}

Status fmi2GetFMUstate(void *c, void **state)
{
    (void)state;
    return unsupported(c);
}

Status fmi2SetFMUstate(void *c, void *state)
{
    (void)state;
    return unsupported(c);
}

Status fmi2FreeFMUstate(void *c, void **state)
{
    (void)state;
    return unsupported(c);
}

Status fmi2SerializedFMUstateSize(void *c, void *state, size_t *size)
{
    (void)state, (void)size;
    return unsupported(c);
}

Status fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t size)
{
    (void)state, (void)bytes, (void)size;
    return unsupported(c);
}

Status fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **state)
{
    (void)bytes, (void)size, (void)state;
    return unsupported(c);
}
