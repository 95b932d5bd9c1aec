// The functions of FMI 2.0 for co-simulation (Modelica Association, 2014, chapters 2 and 4) around `run` of kernel.hpp.
//
// Value references: inputs, levels, readings, parameters, one after the other. A communication step is one call of `run`
// with the inputs held; the next step begins with the levels and memories at its end. The plant is in steady
// memory (settled actuators and sensors) when the first step begins.
#include <algorithm>
#include <cstdarg>
#include <cstring>
#include <exception>
#include <string>

#if defined(_WIN32)
#define FMI extern "C" __declspec(dllexport)
#else
#define FMI extern "C" __attribute__((visibility("default")))
#endif

typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef const char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;

struct fmi2CallbackFunctions {
    void (*logger)(void *, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(void *, fmi2Status);
    void *componentEnvironment;
};

// First value references, and their end.
enum { FIRST_LEVEL = CHANNELS, FIRST_READING = FIRST_LEVEL + TANKS, FIRST_PARAMETER = FIRST_READING + SENSORS };
enum { VALUES = FIRST_PARAMETER + COLUMNS, ROW = STATE + SENSORS };

// The numbers of a plant that change; copied by fmi2GetFMUstate.
struct Plant {
    double begin = 0, time = 0;                                 // begin of the experiment and now, s
    bool has_begun = false;                                     // whether a step was made: `row` is valid
    real inputs[SOME(CHANNELS)] = {}, parameters[SOME(COLUMNS)];
    real row[ROW] = {};                                         // levels, memories, readings
    Plant() { std::copy(START, START + COLUMNS, parameters); }
};

struct Component {
    Plant plant;
    std::string name;
    fmi2CallbackFunctions callbacks;

    fmi2Status fail(const char *message) const {
        if (callbacks.logger)
            callbacks.logger(callbacks.componentEnvironment, name.c_str(), fmi2Error, "logStatusError", "%s", message);
        return fmi2Error;
    }
};

static void *released() { return nullptr; }
static void taken(void *) {}
static int no_signals() { return 0; }
static const Python NO_PYTHON = {released, taken, no_signals};

// Rows at the end of a step of `span` seconds; before the first step also, as the first of two rows, at its beginning.
static std::vector<real> rows_after(const Plant &plant, double span) {
    const int64_t steps = std::max<int64_t>(1, int64_t(std::ceil(span / LONGEST_STEP - 1e-9)));
    const int64_t samples = plant.has_begun ? 1 : 2;
    const real now = plant.time - plant.begin;
    std::vector<real> starts(steps), spans(steps), means(steps * SOME(CHANNELS));
    std::vector<int64_t> first(steps + 1, samples - 1);
    for (int64_t k = 0; k < steps; ++k) {
        starts[k] = now + span * k / steps;
        spans[k] = now + span * (k + 1) / steps - starts[k];
        std::copy(plant.inputs, plant.inputs + CHANNELS, means.begin() + k * CHANNELS);
    }
    first[0] = 0;
    first[steps] = samples;
    const real times[2] = {plant.has_begun ? now + span : now, now + span}, intervals[2] = {span, span};
    const real shares[2] = {plant.has_begun ? 1.0 : 0.0, 1}, resolution = RESOLUTION;
    const std::vector<real> none(2 * std::max<int>(ORDER, 1) * SOME(SENSORS), 0);
    std::vector<real> rows(samples * ROW);
    Job job = {};
    job.lanes = job.lanes_per_problem = job.threads = 1;
    job.steps = steps;
    job.samples = samples;
    job.mode = OBSERVE;
    job.tolerance = TOLERANCE;
    job.shortest = SHORTEST_STEP;
    job.theta = plant.parameters;
    job.nominal = START;
    job.lifted = LIFTED;
    job.resolution = &resolution;
    job.starts = starts.data();
    job.spans = spans.data();
    job.means = means.data();
    job.first_sample = first.data();
    job.sample_times = times;
    job.sample_intervals = intervals;
    job.sample_shares = shares;
    job.values = job.weights = job.centres = job.gains = none.data();
    job.start = plant.has_begun ? plant.row : nullptr;
    job.start_width = ORDER;
    job.start_memory = plant.has_begun && MEMORY ? plant.row + ORDER : nullptr;
    job.out = rows.data();
    job.python = &NO_PYTHON;
    run(&job);
    return rows;
}

FMI const char *fmi2GetTypesPlatform() { return "default"; }
FMI const char *fmi2GetVersion() { return "2.0"; }

FMI fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String,
                                  const fmi2CallbackFunctions *callbacks, fmi2Boolean, fmi2Boolean) {
    Component *c = nullptr;
    try {
        c = new Component{{}, name ? name : "", *callbacks};
    } catch (const std::exception &) {
        return nullptr;
    }
    const bool is_same = guid && !std::strcmp(guid, GUID);
    if (type == fmi2CoSimulation && is_same) return c;
    c->fail(is_same ? "expected co-simulation, got model exchange" : "expected the guid of modelDescription.xml, got another");
    delete c;
    return nullptr;
}
FMI void fmi2FreeInstance(fmi2Component c) { delete static_cast<Component *>(c); }

FMI fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean, fmi2Real, fmi2Real start, fmi2Boolean, fmi2Real) {
    Plant &plant = static_cast<Component *>(c)->plant;
    plant.begin = plant.time = start;
    return fmi2OK;
}
FMI fmi2Status fmi2EnterInitializationMode(fmi2Component) { return fmi2OK; }
FMI fmi2Status fmi2ExitInitializationMode(fmi2Component) { return fmi2OK; }
FMI fmi2Status fmi2Terminate(fmi2Component) { return fmi2OK; }
FMI fmi2Status fmi2Reset(fmi2Component c) {
    static_cast<Component *>(c)->plant = Plant();
    return fmi2OK;
}

FMI fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference *of, size_t count, const fmi2Real *values) {
    Component &component = *static_cast<Component *>(c);
    for (size_t i = 0; i < count; ++i) {
        if (!std::isfinite(values[i])) return component.fail("expected a finite number, got another");
        if (of[i] < FIRST_LEVEL)
            component.plant.inputs[of[i]] = values[i];
        else if (of[i] >= FIRST_PARAMETER && of[i] < VALUES)
            component.plant.parameters[of[i] - FIRST_PARAMETER] = values[i];
        else
            return component.fail("expected an input or a parameter to be set, got an output");
    }
    return fmi2OK;
}

FMI fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference *of, size_t count, fmi2Real *values) {
    Component &component = *static_cast<Component *>(c);
    Plant &plant = component.plant;
    std::vector<real> first;
    for (size_t i = 0; i < count; ++i) {
        if (of[i] >= VALUES) return component.fail("expected a value reference of modelDescription.xml, got another");
        if (of[i] >= FIRST_LEVEL && of[i] < FIRST_PARAMETER && !plant.has_begun && first.empty())
            try {
                first = rows_after(plant, LONGEST_STEP);
            } catch (const std::exception &error) {
                return component.fail(error.what());
            }
        const real *row = plant.has_begun ? plant.row : first.data();
        values[i] = of[i] < FIRST_LEVEL       ? plant.inputs[of[i]]
                    : of[i] < FIRST_READING   ? row[of[i] - FIRST_LEVEL]
                    : of[i] < FIRST_PARAMETER ? row[STATE + of[i] - FIRST_READING]
                                              : plant.parameters[of[i] - FIRST_PARAMETER];
    }
    return fmi2OK;
}

FMI fmi2Status fmi2DoStep(fmi2Component c, fmi2Real now, fmi2Real span, fmi2Boolean) {
    Component &component = *static_cast<Component *>(c);
    if (!(span > 0)) return component.fail("expected a communication step longer than 0 s, got a shorter one");
    try {
        component.plant.time = now;
        const std::vector<real> rows = rows_after(component.plant, span);
        for (auto value = rows.end() - ROW; value != rows.end(); ++value)
            if (!std::isfinite(*value)) return component.fail("expected finite levels, got others; check the parameters");
        std::copy(rows.end() - ROW, rows.end(), component.plant.row);
        component.plant.has_begun = true;
        component.plant.time = now + span;
    } catch (const std::exception &error) {
        return component.fail(error.what());
    }
    return fmi2OK;
}

FMI fmi2Status fmi2GetFMUstate(fmi2Component c, void **state) {
    const Plant &plant = static_cast<Component *>(c)->plant;
    if (*state)
        *static_cast<Plant *>(*state) = plant;
    else
        *state = new Plant(plant);
    return fmi2OK;
}
FMI fmi2Status fmi2SetFMUstate(fmi2Component c, void *state) {
    static_cast<Component *>(c)->plant = *static_cast<Plant *>(state);
    return fmi2OK;
}
FMI fmi2Status fmi2FreeFMUstate(fmi2Component, void **state) {
    delete static_cast<Plant *>(*state);
    *state = nullptr;
    return fmi2OK;
}
FMI fmi2Status fmi2SerializedFMUstateSize(fmi2Component, void *, size_t *size) {
    *size = sizeof(Plant);
    return fmi2OK;
}
FMI fmi2Status fmi2SerializeFMUstate(fmi2Component, void *state, char *bytes, size_t) {
    std::memcpy(bytes, state, sizeof(Plant));
    return fmi2OK;
}
FMI fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const char *bytes, size_t size, void **state) {
    if (size != sizeof(Plant)) return static_cast<Component *>(c)->fail("expected a state of this FMU, got another");
    if (!*state) *state = new Plant();
    std::memcpy(*state, bytes, sizeof(Plant));
    return fmi2OK;
}

// Functions that the standard requires and this FMU does not need.
FMI fmi2Status fmi2SetDebugLogging(fmi2Component, fmi2Boolean, size_t, const fmi2String *) { return fmi2OK; }
FMI fmi2Status fmi2CancelStep(fmi2Component) { return fmi2Error; }
FMI fmi2Status fmi2GetDirectionalDerivative(fmi2Component, const fmi2ValueReference *, size_t, const fmi2ValueReference *,
                                            size_t, const fmi2Real *, fmi2Real *) {
    return fmi2Error;
}
FMI fmi2Status fmi2SetRealInputDerivatives(fmi2Component, const fmi2ValueReference *, size_t, const fmi2Integer *,
                                           const fmi2Real *) {
    return fmi2Error;
}
FMI fmi2Status fmi2GetRealOutputDerivatives(fmi2Component, const fmi2ValueReference *, size_t, const fmi2Integer *,
                                            fmi2Real *) {
    return fmi2Error;
}
#define NONE_OF_TYPE(Type, name)                                                                        \
    FMI fmi2Status fmi2Get##name(fmi2Component, const fmi2ValueReference *, size_t n, Type *) {         \
        return n ? fmi2Error : fmi2OK;                                                                  \
    }                                                                                                   \
    FMI fmi2Status fmi2Set##name(fmi2Component, const fmi2ValueReference *, size_t n, const Type *) {   \
        return n ? fmi2Error : fmi2OK;                                                                  \
    }
NONE_OF_TYPE(fmi2Integer, Integer)
NONE_OF_TYPE(fmi2Boolean, Boolean)
NONE_OF_TYPE(fmi2String, String)
#define NO_STATUS(Type, name) \
    FMI fmi2Status fmi2Get##name(fmi2Component, int, Type *) { return fmi2Discard; }
NO_STATUS(fmi2Status, Status)
NO_STATUS(fmi2Real, RealStatus)
NO_STATUS(fmi2Integer, IntegerStatus)
NO_STATUS(fmi2Boolean, BooleanStatus)
NO_STATUS(fmi2String, StringStatus)
