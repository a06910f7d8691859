/* {{ name }}.c as an FMU {{ version }}.0 for co-simulation. */
#include "{{ name }}.h"

#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { NX = {{ NAME }}_NX, NU = {{ NAME }}_NU, NY = {{ NAME }}_NY };

/* Value references: the inputs, the outputs, the states, the time. */
enum { FIRST_Y = NU, FIRST_X = NU + NY, TIME = NU + NY + NX };

/* The binary interface of FMI {{ version }}.0, as far as it is used. */
typedef enum { OK, WARNING, DISCARD, ERROR } Status;

{% if version == 2 %}
typedef struct {
    void (*logger)(void *environment, const char *instance, Status status, const char *category,
        const char *message, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, Status status);
    void *environment;
} Callbacks;

enum { CO_SIMULATION = 1 };

{% else %}
typedef void Logger(void *environment, Status status, const char *category, const char *message);

{% endif %}
static const char guid[] = "{{ guid }}";
static const double u_start[NU] = { {{- u_start | join(", ") -}} };

/* Everything that a simulation goes on from. */
typedef struct {
    double time, x[NX], u[NU];
    double held[NU]; /* the inputs at the last sample */
    double elapsed; /* since then, in samples, from 0 to 1 */
} State;

typedef struct {
    State now;
{% if version == 2 %}
    const Callbacks *callbacks;
{% else %}
    Logger *log;
    void *environment;
{% endif %}
} Instance;

static Status failed(const Instance *i, const char *message)
{
{% if version == 2 %}
    const Callbacks *c = i->callbacks;
    if (c && c->logger)
        c->logger(c->environment, "{{ name }}", ERROR, "error", message);
{% else %}
    if (i->log)
        i->log(i->environment, ERROR, "error", message);
{% endif %}
    return ERROR;
}

static Status unsupported(void *c)
{
    return failed(c, "{{ name }} has real variables alone, and no such function");
}

static void restart(State *s)
{
    static const State zero;
    *s = zero;
    {{ name }}_reset(s->x);
    memcpy(s->u, u_start, sizeof u_start);
}

static Instance *made(const char *found{{ ", const Callbacks *callbacks" if version == 2 else ", void *environment, Logger *log" }})
{
    Instance it = { {{- "{0}, callbacks" if version == 2 else "{0}, log, environment" -}} }, *i;
    if (!found || strcmp(found, guid)) {
        failed(&it, "{{ name }} needs the GUID of its description");
        return NULL;
    }
    i = malloc(sizeof *i);
    if (!i)
        return NULL;
    *i = it;
    restart(&i->now);
    return i;
}

/* The inputs of the output: those of now at a sample, and those held between two. */
static const double *inputs(const State *s)
{
    return s->elapsed > 0.0 ? s->held : s->u;
}

static Status get(const Instance *i, const unsigned references[], size_t count, double values[])
{
    const State *s = &i->now;
    double next[NX], y[NY];
    {{ name }}_step(s->x, inputs(s), next, y);
    for (size_t k = 0; k < count; k++) {
        unsigned r = references[k];
        if (r > TIME)
            return failed(i, "{{ name }} has no such real variable");
        values[k] = r < FIRST_Y ? s->u[r]
            : r < FIRST_X       ? y[r - FIRST_Y]
            : r < TIME          ? s->x[r - FIRST_X]
                                : s->time;
    }
    return OK;
}

static Status set(Instance *i, const unsigned references[], size_t count, const double values[])
{
    for (size_t k = 0; k < count; k++) {
        unsigned r = references[k];
        if (r < FIRST_Y)
            i->now.u[r] = values[k];
        else if (r >= FIRST_X && r < TIME)
            i->now.x[r - FIRST_X] = values[k];
        else
            return failed(i, "{{ name }}: inputs and states can be set, outputs cannot");
    }
    return OK;
}

/* A sample has the inputs of its time; inputs that are set between two wait for the next. */
static Status go_on(Instance *i, double time, double size)
{
    State *s = &i->now;
    double y[NY], rounding = 1e-6;
    if (!(size >= 0.0))
        return failed(i, "{{ name }}: a step is not negative");
    if (s->elapsed == 0.0)
        memcpy(s->held, s->u, sizeof s->u);
    s->time = time + size;
    s->elapsed += size / {{ NAME }}_TS;
    for (; s->elapsed > 1.0 - rounding; s->elapsed -= 1.0) {
        {{ name }}_step(s->x, s->held, s->x, y);
        memcpy(s->held, s->u, sizeof s->u);
    }
    if (s->elapsed < rounding)
        s->elapsed = 0.0;
    return OK;
}

/* Derivatives of outputs by inputs and states, times the seeds. */
static Status derive(const Instance *i, const unsigned unknowns[], size_t unknown_count,
    const unsigned knowns[], size_t known_count, const double seeds[], double values[])
{
    double F[NX * NX], B[NX * NU], H[NY * NX], D[NY * NU];
    {{ name }}_jacobians(i->now.x, inputs(&i->now), F, B, H, D);
    for (size_t a = 0; a < unknown_count; a++) {
        unsigned y = unknowns[a] - FIRST_Y;
        if (y >= NY)
            return failed(i, "{{ name }}: outputs alone have derivatives");
        values[a] = 0.0;
        for (size_t b = 0; b < known_count; b++) {
            unsigned r = knowns[b];
            if (r >= TIME || (r >= FIRST_Y && r < FIRST_X))
                return failed(i, "{{ name }}: derivatives are those by inputs and states");
            values[a] += seeds[b] * (r < FIRST_Y ? D[y * NU + r] : H[y * NX + r - FIRST_X]);
        }
    }
    return OK;
}

{% set fmi = "fmi%d" % version %}
{% if version == 2 %}
const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

void *fmi2Instantiate(const char *name, int type, const char *found, const char *resources,
    const Callbacks *callbacks, int visible, int logging)
{
    (void)name, (void)resources, (void)visible, (void)logging;
    return made(type == CO_SIMULATION ? found : NULL, callbacks);
}

Status fmi2SetupExperiment(void *c, int tolerance_given, double tolerance, double start,
    int stop_given, double stop)
{
    Instance *i = c;
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop;
    i->now.time = start;
    return OK;
}

Status fmi2EnterInitializationMode(void *c)
{
    (void)c;
    return OK;
}

Status fmi2GetReal(void *c, const unsigned references[], size_t count, double values[])
{
    return get(c, references, count, values);
}

Status fmi2SetReal(void *c, const unsigned references[], size_t count, const double values[])
{
    return set(c, references, count, values);
}

Status fmi2DoStep(void *c, double time, double size, int no_return)
{
    (void)no_return;
    return go_on(c, time, size);
}

Status fmi2GetDirectionalDerivative(void *c, const unsigned unknowns[], size_t unknown_count,
    const unsigned knowns[], size_t known_count, const double seeds[], double values[])
{
    return derive(c, unknowns, unknown_count, knowns, known_count, seeds, values);
}
{% else %}
void *fmi3InstantiateCoSimulation(const char *name, const char *found, const char *resources,
    _Bool visible, _Bool logging, _Bool events, _Bool early, const unsigned required[],
    size_t count, void *environment, Logger *log, void (*update)(void))
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)required, (void)count, (void)update;
    return made(found, environment, log);
}

void *fmi3InstantiateModelExchange(void)
{
    return NULL;
}

void *fmi3InstantiateScheduledExecution(void)
{
    return NULL;
}

Status fmi3EnterInitializationMode(void *c, _Bool tolerance_given, double tolerance, double start,
    _Bool stop_given, double stop)
{
    Instance *i = c;
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop;
    i->now.time = start;
    return OK;
}

Status fmi3GetFloat64(void *c, const unsigned references[], size_t count, double values[],
    size_t numbers)
{
    return numbers == count ? get(c, references, count, values) : ERROR;
}

Status fmi3SetFloat64(void *c, const unsigned references[], size_t count, const double values[],
    size_t numbers)
{
    return numbers == count ? set(c, references, count, values) : ERROR;
}

Status fmi3DoStep(void *c, double time, double size, _Bool no_return, _Bool *event,
    _Bool *terminate, _Bool *early, double *last)
{
    (void)no_return;
    *event = *terminate = *early = 0;
    *last = time + size;
    return go_on(c, time, size);
}

Status fmi3GetDirectionalDerivative(void *c, const unsigned unknowns[], size_t unknown_count,
    const unsigned knowns[], size_t known_count, const double seeds[], size_t seed_count,
    double values[], size_t value_count)
{
    if (seed_count != known_count || value_count != unknown_count)
        return ERROR;
    return derive(c, unknowns, unknown_count, knowns, known_count, seeds, values);
}
{% endif %}

const char *{{ fmi }}GetVersion(void)
{
    return "{{ version }}.0";
}

Status {{ fmi }}SetDebugLogging(void *c, int on, size_t count, const char *const categories[])
{
    (void)c, (void)on, (void)count, (void)categories;
    return OK;
}

Status {{ fmi }}ExitInitializationMode(void *c)
{
    (void)c;
    return OK;
}

Status {{ fmi }}Terminate(void *c)
{
    (void)c;
    return OK;
}

Status {{ fmi }}Reset(void *c)
{
    restart(&((Instance *)c)->now);
    return OK;
}

void {{ fmi }}FreeInstance(void *c)
{
    free(c);
}

{% set State = "FMUstate" if version == 2 else "FMUState" %}
Status {{ fmi }}Get{{ State }}(void *c, void **state)
{
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return failed(c, "{{ name }}: no memory");
    memcpy(*state, &((Instance *)c)->now, sizeof(State));
    return OK;
}

Status {{ fmi }}Set{{ State }}(void *c, void *state)
{
    memcpy(&((Instance *)c)->now, state, sizeof(State));
    return OK;
}

Status {{ fmi }}Free{{ State }}(void *c, void **state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return OK;
}

Status {{ fmi }}Serialized{{ State }}Size(void *c, void *state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(State);
    return OK;
}

Status {{ fmi }}Serialize{{ State }}(void *c, void *state, char bytes[], size_t size)
{
    if (size < sizeof(State))
        return failed(c, "{{ name }}: too few bytes for a state");
    memcpy(bytes, state, sizeof(State));
    return OK;
}

Status {{ fmi }}{{ "DeSerialize" if version == 2 else "Deserialize" }}{{ State }}(void *c, const char bytes[], size_t size, void **state)
{
    if (size != sizeof(State))
        return failed(c, "{{ name }}: these bytes are no state of it");
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return failed(c, "{{ name }}: no memory");
    memcpy(*state, bytes, sizeof(State));
    return OK;
}
{# Types of variables that there are none of, and functions that no unit for co-simulation of a
   sampled model needs. #}
{% if version == 2 %}
{% set others = ["Integer", "Boolean", "String"] %}
{% set unsupported = [
    "CancelStep", "GetStatus", "GetRealStatus", "GetIntegerStatus", "GetBooleanStatus",
    "GetStringStatus", "SetRealInputDerivatives", "GetRealOutputDerivatives",
] %}
{% else %}
{% set others = [
    "Float32", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64",
    "Boolean", "String", "Binary", "Clock",
] %}
{% set unsupported = [
    "GetNumberOfVariableDependencies", "GetVariableDependencies", "GetAdjointDerivative",
    "EnterConfigurationMode", "ExitConfigurationMode", "EnterEventMode", "EnterStepMode",
    "GetIntervalDecimal", "GetIntervalFraction", "GetShiftDecimal", "GetShiftFraction",
    "SetIntervalDecimal", "SetIntervalFraction", "SetShiftDecimal", "SetShiftFraction",
    "EvaluateDiscreteStates", "UpdateDiscreteStates", "EnterContinuousTimeMode",
    "CompletedIntegratorStep", "SetTime", "SetContinuousStates",
    "GetContinuousStateDerivatives", "GetEventIndicators", "GetContinuousStates",
    "GetNominalsOfContinuousStates", "GetNumberOfEventIndicators",
    "GetNumberOfContinuousStates", "GetOutputDerivatives", "ActivateModelPartition",
] %}
{% endif %}
{% for kind in others %}

Status {{ fmi }}Get{{ kind }}(void *c, const unsigned references[], size_t count)
{
    (void)references;
    return count ? unsupported(c) : OK;
}

Status {{ fmi }}Set{{ kind }}(void *c, const unsigned references[], size_t count)
{
    (void)references;
    return count ? unsupported(c) : OK;
}
{% endfor %}
{% for function in unsupported %}

Status {{ fmi }}{{ function }}(void *c)
{
    return unsupported(c);
}
{% endfor %}
