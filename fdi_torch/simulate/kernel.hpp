// The loop over blocks of lanes, steps and samples around a plant's generated sections.
//
// A block is LANES trajectories side by side: each array below has one number per lane, and each inner loop runs over
// the lanes and becomes vector instructions. No lane reads another lane's numbers, and every block is full (an incomplete
// last block repeats its last lane), so that a trajectory does not depend on its neighbours, their number, or the threads.
#include <atomic>
#include <chrono>
#include <limits>
#include <thread>
#include <vector>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#define EACH_LANE _Pragma("GCC ivdep") for (int l = 0; l < LANES; ++l)
#define SOME(n) ((n) > 0 ? (n) : 1)

enum Mode { LEVELS, READINGS, MOMENTS, LINEARISE, GRAM, OBSERVE };
enum { MEMORY = COMMAND_MEMORY + READING_MEMORY, STATE = ORDER + MEMORY };

// Functions of Python: release and take back the global lock, and run signal handlers (nonzero: one raised an exception).
struct Python {
    void *(*release)();
    void (*take)(void *);
    int (*signals)();
};

struct Job {
    int64_t lanes, lanes_per_problem, steps, samples, signal_samples, mode, threads, gain_stride;
    int64_t start_width, out_bytes, jacobian_bytes;          // start_width: TANKS or ORDER
    double tolerance, slope_tolerance, shortest;             // step control: m, relative, s
    const real *theta, *nominal, *lifted, *resolution;
    const real *starts, *spans, *means;                      // (K), (K), (K, CHANNELS)
    const int64_t *first_sample;                             // (K + 1): step k holds samples first[k] .. first[k + 1]
    const real *sample_times, *sample_intervals, *sample_shares;
    const real *signal_times, *signal_integral, *signal_slopes;  // (T), (T, CHANNELS), (T + 1, CHANNELS)
    const real *values, *weights, *centres;                  // (problems, S, SENSORS) twice, (problems, SENSORS)
    const real *gains, *start, *start_memory;                // (lanes or 1, S, ORDER, SENSORS), (lanes, start_width), (lanes, MEMORY)
    real *out, *jacobian;
    const Python *python;
};

static constexpr std::chrono::milliseconds INTERVAL(50);

// Stop flag of all threads; the calling thread checks at intervals whether it was interrupted.
struct Watch {
    explicit Watch(const Python *python) : python(python), state(python->release()) {}
    ~Watch() { python->take(state); }

    void look() {
        const auto now = std::chrono::steady_clock::now();
        if (now < next) return;
        next = now + INTERVAL;
        python->take(state);
        if (python->signals()) stop = true;
        state = python->release();
    }

    std::atomic<bool> stop{false};
    const Python *python;
    void *state;
    std::chrono::steady_clock::time_point next = std::chrono::steady_clock::now();
};

#if !UNROLLED && !WITHIN
#define STAGES 3  // besides the first
#endif

using Lane = real[LANES];

struct Block {
    alignas(64) Lane theta[SOME(COLUMNS)];
    Lane lane[SOME(LANE_CONSTANTS)];
    Lane level[ORDER], before[ORDER], sample[ORDER], slope_left[ORDER], slope_right[ORDER];
    Lane action[SOME(ACTUATORS)], command_memory[SOME(COMMAND_MEMORY)], late_channel[SOME(LATE_ACTUATORS)];
    Lane integral[SOME(LATE_ACTUATORS)], late_slope[SOME(LATE_ACTUATORS)];   // of delayed channels, up to the present
    Lane command_delay[SOME(LATE_ACTUATORS)], reading_delay[SOME(LATE_SENSORS)];
    Lane seen[SENSORS], reading[SENSORS], reading_memory[SOME(READING_MEMORY)];
    Lane value, weight, centre;
    Lane squares[SENSORS][3];
#if WITHIN
    Lane part[2], pace, gone, failed;                        // of a lane's adaptive step: clock, planned length, elapsed time, whether it failed
    Lane base[ORDER], move[ORDER], error[ORDER];
    Lane factor[ENTRIES], inverse[ORDER];                    // of 1 - g df/dh
#if TANGENT
    Lane d_error[COLUMNS][ORDER], d_size[COLUMNS];
#endif
#endif
#if !UNROLLED
    Lane slope[ORDER], by_level[SOME(SLOPES_BY_LEVEL)], stage[STAGES + 1][ORDER];
#if TANGENT
    Lane d_slope[COLUMNS][ORDER], d_stage[STAGES + 1][COLUMNS][ORDER];
#endif
#endif
#if TANGENT
    Lane row[SOME(ROWS)][COLUMNS];                           // direct slope of each output by theta
    Lane d_level[COLUMNS][ORDER], d_before[COLUMNS][ORDER], d_sample[COLUMNS][ORDER];
    Lane d_slope_left[COLUMNS][ORDER], d_slope_right[COLUMNS][ORDER], d_action[COLUMNS][SOME(ACTUATORS)];
    Lane d_command_memory[COLUMNS][SOME(COMMAND_MEMORY)], d_late_channel[COLUMNS][SOME(LATE_ACTUATORS)];
    Lane d_command_delay[COLUMNS][SOME(LATE_ACTUATORS)], d_reading_delay[COLUMNS][SOME(LATE_SENSORS)];
    Lane d_seen[COLUMNS][SENSORS], d_reading[COLUMNS][SENSORS], d_reading_memory[COLUMNS][SOME(READING_MEMORY)];
    Lane gram[SENSORS][PAIRS], column[WIDTH];
#endif
    real uniform[SOME(UNIFORM_CONSTANTS)];
    int64_t end[SOME(LATE_ACTUATORS)][LANES], past[SOME(LATE_SENSORS)][LANES];
    int64_t problem[LANES];
    bool one_problem, looks;
    int turns;
    Watch *watch;
    const real *nominal, *lifted;
    real resolution;
    std::vector<real> history, d_history;                    // (LATE_SENSORS, S, LANES), (COLUMNS, LATE_SENSORS, S, LANES)
};

//@SECTIONS@

// As in plant/signals.py: at a switch the slope is the one before it, because a delay looks back.
static const real SAME_INSTANT = 1e-9;

// The integral of channel c up to an instant; i advances to the index of the slope that holds there.
static real up_to(const Job &job, int c, real instant, int64_t &i, real &slope) {
    while (i < job.signal_samples && job.signal_times[i] < instant - SAME_INSTANT) ++i;
    const int64_t left = i > 0 ? i - 1 : 0;
    slope = job.signal_slopes[i * CHANNELS + c];
    return job.signal_integral[left * CHANNELS + c] + slope * (instant - job.signal_times[left]);
}

// The exact mean of a held or linear signal over [start - delay, start - delay + span]. Each interval begins where the
// preceding one ended.
static void look_up_late_channels(const Job &job, Block &b, real start, real span, bool first) {
    for (int j = 0; j < LATE_ACTUATORS; ++j) {
        const int c = LATE_CHANNEL[j];
        for (int l = 0; l < LANES; ++l) {
            const real from = start - b.command_delay[j][l];
            if (first) b.integral[j][l] = up_to(job, c, from, b.end[j][l], b.late_slope[j][l]);
            real slope;
            const real after = up_to(job, c, from + span, b.end[j][l], slope);
            b.late_channel[j][l] = (after - b.integral[j][l]) / span;
#if TANGENT
            for (int p = 0; p < COLUMNS; ++p)
                b.d_late_channel[p][j][l] = -(slope - b.late_slope[j][l]) / span * b.d_command_delay[p][j][l];
#endif
            b.integral[j][l] = after;
            b.late_slope[j][l] = slope;
        }
    }
}

// Replaces the level at each delayed sensor by the earlier level of its tank, interpolated linearly between samples.
static void look_up_late_levels(const Job &job, Block &b, int64_t s) {
    for (int j = 0; j < LATE_SENSORS; ++j) {
        Lane *history = reinterpret_cast<Lane *>(b.history.data()) + j * job.samples;
        const int i = LATE_SENSOR[j];
        std::memcpy(history[s], b.seen[i], sizeof(Lane));
#if TANGENT
        for (int p = 0; p < COLUMNS; ++p)
            std::memcpy(b.d_history.data() + ((p * LATE_SENSORS + j) * job.samples + s) * LANES, b.d_seen[p][i], sizeof(Lane));
#endif
        if (s == 0) continue;
        for (int l = 0; l < LANES; ++l) {
            const real delay = b.reading_delay[j][l];
            const real wanted = job.sample_times[s] - (delay < 0 ? 0 : delay);
            int64_t &k = b.past[j][l];
            while (k < s && job.sample_times[k] < wanted) ++k;
            const int64_t right = k > 1 ? k : 1, left = right - 1;
            const real gap = job.sample_times[right] - job.sample_times[left];
            const real linear = (wanted - job.sample_times[left]) / gap, share = linear < 0 ? 0 : linear;
            const real rise = history[right][l] - history[left][l];
            b.seen[i][l] = history[left][l] + share * rise;
#if TANGENT
            const real slope = linear > 0 && delay >= 0 ? -rise / gap : 0;
            for (int p = 0; p < COLUMNS; ++p) {
                const real *past = b.d_history.data() + ((p * LATE_SENSORS + j) * job.samples) * LANES + l;
                const real first = past[left * LANES];
                b.d_seen[p][i][l] = first + share * (past[right * LANES] - first) + slope * b.d_reading_delay[p][j][l];
            }
#endif
        }
    }
}

static void copy_levels(Block &b, bool from_before) {
    std::memcpy(b.sample, from_before ? b.before : b.level, sizeof b.sample);
#if TANGENT
    std::memcpy(b.d_sample, from_before ? b.d_before : b.d_level, sizeof b.d_sample);
#endif
}

static inline void remember_levels(Block &b) {
    std::memcpy(b.before, b.level, sizeof b.level);
#if TANGENT
    std::memcpy(b.d_before, b.d_level, sizeof b.d_level);
#endif
}

// The cubic through the levels and slopes at both ends of a step.
static void interpolate(Lane *out, const Lane *left, const Lane *right, const Lane *slope_left, const Lane *slope_right,
                        real span, real share) {
    const real rest = 1 - share, bend_left = share * rest * rest, bend_right = share * share * rest;
    const real blend = share * share * (3 - 2 * share);
    for (int i = 0; i < ORDER; ++i)
        EACH_LANE out[i][l] = left[i][l] + blend * (right[i][l] - left[i][l])
                              + span * (bend_left * slope_left[i][l] - bend_right * slope_right[i][l]);
}

static void take_sample(Block &b, real span, real share) {
    if (share >= 1) return copy_levels(b, false);
    interpolate(b.sample, b.before, b.level, b.slope_left, b.slope_right, span, share);
#if TANGENT
    for (int p = 0; p < COLUMNS; ++p)
        interpolate(b.d_sample[p], b.d_before[p], b.d_level[p], b.d_slope_left[p], b.d_slope_right[p], span, share);
#endif
}

static void fetch_data(const Job &job, Block &b, int64_t s, int c) {
    const int64_t at = s * SENSORS + c, size = job.samples * SENSORS;
    for (int l = 0; l < LANES; ++l) {
        const int64_t problem = b.one_problem ? b.problem[0] : b.problem[l];
        b.value[l] = job.values[problem * size + at];
        b.weight[l] = job.weights[problem * size + at];
        b.centre[l] = job.centres[problem * SENSORS + c];
    }
}

static void add_moments(const Job &job, Block &b, int64_t s) {
    for (int c = 0; c < SENSORS; ++c) {
        fetch_data(job, b, s, c);
        EACH_LANE {
            const real r = b.value[l] - b.reading[c][l], wr = b.weight[l] * r;
            b.squares[c][0][l] += wr;
            b.squares[c][1][l] += wr * r;
            b.squares[c][2][l] += wr * (b.value[l] - b.centre[l]);
        }
    }
}

#if TANGENT
static void add_gram(const Job &job, Block &b, int64_t s) {
    for (int c = 0; c < SENSORS; ++c) {
        fetch_data(job, b, s, c);
        for (int p = 0; p < COLUMNS; ++p) EACH_LANE b.column[p][l] = b.d_reading[p][c][l];
        EACH_LANE {
            b.column[COLUMNS][l] = b.value[l] - b.reading[c][l];
            b.column[COLUMNS + 1][l] = b.value[l] - b.centre[l];
            b.column[COLUMNS + 2][l] = 1;
        }
        Lane *sum = b.gram[c];
        for (int m = 0; m < WIDTH; ++m) {
            Lane weighted;
            EACH_LANE weighted[l] = b.weight[l] != 0 ? b.weight[l] * b.column[m][l] : 0;
            for (int n = 0; n <= m; ++n, ++sum) EACH_LANE (*sum)[l] += weighted[l] * b.column[n][l];
        }
    }
}
#endif

static bool is_interrupted(Block &b) {
    if (b.looks && ++b.turns % 64 == 0) b.watch->look();
    return b.watch->stop.load(std::memory_order_relaxed);
}

struct Rows {  // rows of the results that belong to the lanes of a block
    int64_t first, count;
};

static void write(const Job &job, Block &b, const Rows &rows, int64_t s) {
    const bool levels = job.mode == LEVELS;
    const int width = levels ? TANKS : SENSORS;
    const Lane *from = levels ? b.sample : b.reading;
    for (int64_t l = 0; l < rows.count; ++l) {
        real *out = job.out + ((rows.first + l) * job.samples + s) * width;
        for (int i = 0; i < width; ++i) out[i] = from[i][l];
    }
#if TANGENT
    if (job.mode != LINEARISE) return;
    for (int64_t l = 0; l < rows.count; ++l) {
        real *out = job.jacobian + ((rows.first + l) * job.samples + s) * SENSORS * COLUMNS;
        for (int i = 0; i < SENSORS; ++i)
            for (int p = 0; p < COLUMNS; ++p) *out++ = b.d_reading[p][i][l];
    }
#endif
}

// Observer correction at a sample: state += gain (value - reading) for valid readings, with no level below zero. Writes
// the corrected state and the predicted reading.
static void correct(const Job &job, Block &b, const Rows &rows, int64_t s) {
    Lane error[SENSORS];
    for (int c = 0; c < SENSORS; ++c) {
        fetch_data(job, b, s, c);
        EACH_LANE error[c][l] = b.weight[l] != 0 ? b.value[l] - b.reading[c][l] : 0;
    }
    for (int64_t l = 0; l < LANES; ++l) {
        const int64_t lane = rows.first + (l < rows.count ? l : rows.count - 1);
        const real *gain = job.gains + lane * job.gain_stride + s * ORDER * SENSORS;
        for (int i = 0; i < ORDER; ++i) {
            real move = 0;
            for (int c = 0; c < SENSORS; ++c) move += *gain++ * error[c][l];
            const real level = b.level[i][l] + move;
            b.level[i][l] = i < TANKS && level < 0 ? 0 : level;
        }
    }
    for (int64_t l = 0; l < rows.count; ++l) {
        real *out = job.out + ((rows.first + l) * job.samples + s) * (STATE + SENSORS);
        for (int i = 0; i < ORDER; ++i) *out++ = b.level[i][l];
        for (int i = 0; i < COMMAND_MEMORY; ++i) *out++ = b.command_memory[i][l];
        for (int i = 0; i < READING_MEMORY; ++i) *out++ = b.reading_memory[i][l];
        for (int c = 0; c < SENSORS; ++c) *out++ = b.reading[c][l];
    }
}

// The given initial values of a run, if any: levels or the whole state, and the memories of actuators and sensors.
static void begin_with(Lane *into, const real *from, int width, int first, int count, const Rows &rows) {
    if (!from) return;
    for (int64_t l = 0; l < LANES; ++l) {
        const int64_t lane = rows.first + (l < rows.count ? l : rows.count - 1);
        for (int i = 0; i < count; ++i) into[i][l] = from[lane * width + first + i];
    }
}

static void consume(const Job &job, Block &b, const Rows &rows, int64_t s) {
    if (job.mode == LEVELS) return write(job, b, rows, s);
    for (int i = 0; i < SENSORS; ++i) {
        std::memcpy(b.seen[i], b.sample[SENSOR_TANK[i]], sizeof(Lane));
#if TANGENT
        for (int p = 0; p < COLUMNS; ++p) std::memcpy(b.d_seen[p][i], b.d_sample[p][SENSOR_TANK[i]], sizeof(Lane));
#endif
    }
    look_up_late_levels(job, b, s);
    const real clock[2] = {job.sample_times[s] - job.sample_intervals[s], job.sample_intervals[s]};
    if (s == 0) {
        settle_readings(b, clock, nullptr);
        begin_with(b.reading_memory, job.start_memory, MEMORY, COMMAND_MEMORY, READING_MEMORY, rows);
    }
    read(b, clock, nullptr);
    if (job.mode == READINGS || job.mode == LINEARISE) write(job, b, rows, s);
    if (job.mode == MOMENTS) add_moments(job, b, s);
    if (job.mode == OBSERVE) correct(job, b, rows, s);
#if TANGENT
    if (job.mode == GRAM) add_gram(job, b, s);
#endif
}

static void load(const Job &job, Block &b, const Rows &rows) {
    for (int l = 0; l < LANES; ++l) {
        const int64_t lane = rows.first + (l < rows.count ? l : rows.count - 1);
        for (int i = 0; i < COLUMNS; ++i) b.theta[i][l] = job.theta[lane * COLUMNS + i];
        b.problem[l] = lane / job.lanes_per_problem;
    }
    b.one_problem = b.problem[0] == b.problem[LANES - 1];
    std::memset(b.end, 0, sizeof b.end);
    std::memset(b.past, 0, sizeof b.past);
    std::memset(b.squares, 0, sizeof b.squares);
#if WITHIN
    EACH_LANE b.pace[l] = INFINITY;
#if TANGENT
    std::memset(b.d_size, 0, sizeof b.d_size);
#endif
#endif
#if !UNROLLED && TANGENT
    std::memset(b.d_slope, 0, sizeof b.d_slope);
#endif
#if TANGENT
    std::memset(b.d_level, 0, sizeof b.d_level);
    std::memset(b.d_command_memory, 0, sizeof b.d_command_memory);
    std::memset(b.d_reading_memory, 0, sizeof b.d_reading_memory);
    std::memset(b.gram, 0, sizeof b.gram);
#endif
}

static void finish(const Job &job, const Block &b, const Rows &rows) {
    for (int64_t l = 0; l < rows.count; ++l) {
        if (job.mode == MOMENTS) {
            real *out = job.out + (rows.first + l) * SENSORS * 3;
            for (int c = 0; c < SENSORS; ++c)
                for (int m = 0; m < 3; ++m) *out++ = b.squares[c][m][l];
        }
#if TANGENT
        if (job.mode != GRAM) continue;
        for (int c = 0; c < SENSORS; ++c) {
            real *out = job.out + ((rows.first + l) * SENSORS + c) * WIDTH * WIDTH;
            for (int m = 0, pair = 0; m < WIDTH; ++m)
                for (int n = 0; n <= m; ++n, ++pair) out[m * WIDTH + n] = out[n * WIDTH + m] = b.gram[c][pair][l];
        }
#endif
    }
}

static bool has_inner_sample(const Job &job, int64_t k) {
    for (int64_t s = job.first_sample[k]; s < job.first_sample[k + 1]; ++s)
        if (job.sample_shares[s] > 0 && job.sample_shares[s] < 1) return true;
    return false;
}

#if !UNROLLED
// The rates at the levels and their slopes by theta, stored as those of stage s.
static void take_rates(Block &b, const real *clock, const real *channel, int s) {
    rates(b, clock, channel);
    std::memcpy(b.stage[s], b.slope, sizeof b.slope);
#if TANGENT
    for (int p = 0; p < COLUMNS; ++p) {
        std::memcpy(b.d_stage[s][p], b.d_slope[p], sizeof b.d_slope[p]);
        for (int e = 0; e < SLOPES_BY_LEVEL; ++e)
            EACH_VECTOR AT(b.d_stage[s][p][SLOPE_ROW[e]]) += AT(b.by_level[e]) * AT(b.d_level[p][SLOPE_COLUMN[e]]);
    }
#endif
}
#endif

#if !UNROLLED && !WITHIN
// The levels of stage s of RK4 by the 3/8 rule, or for s = 4 those after the step; in the order of runge_kutta.py.
static inline void move_on(Lane *level, const Lane *before, Lane *k, int stride, real step, int s) {
    const real third = real(1.0 / 3.0);
    for (int i = 0; i < ORDER; ++i) EACH_LANE {
        const real k1 = k[i][l], k2 = k[stride + i][l], k3 = k[2 * stride + i][l], k4 = k[3 * stride + i][l];
        const real change = s == 1 ? k1 * step * third
                            : s == 2 ? (k2 - k1 * third) * step
                            : s == 3 ? (k1 - k2 + k3) * step
                                     : (k1 + (k2 + k3) * 3 + k4) * step * real(0.125);
        level[i][l] = before[i][l] + change;
    }
}

static void step(Block &b, const real *clock, const real *channel) {
    act(b, clock, channel);
    remember_levels(b);
    for (int s = 0; s < 4; ++s) {
        take_rates(b, clock, channel, s);
        move_on(b.level, b.before, b.stage[0], ORDER, clock[1], s + 1);
#if TANGENT
        for (int p = 0; p < COLUMNS; ++p)
            move_on(b.d_level[p], b.d_before[p], b.d_stage[0][p], ORDER * COLUMNS, clock[1], s + 1);
#endif
    }
}

// The rates at both ends of the last step, for samples within it.
static void end(Block &b, const real *clock, const real *channel) {
    std::memcpy(b.slope_left, b.stage[0], sizeof b.slope_left);
#if TANGENT
    std::memcpy(b.d_slope_left, b.d_stage[0], sizeof b.d_slope_left);
#endif
    take_rates(b, clock, channel, 0);
    std::memcpy(b.slope_right, b.stage[0], sizeof b.slope_right);
#if TANGENT
    std::memcpy(b.d_slope_right, b.d_stage[0], sizeof b.d_slope_right);
#endif
}
#endif

#if WITHIN
// Begins the next step of each lane: its planned length, or less, so that no short step remains before the end of the
// span; a finished lane takes one that is not used. Returns whether any lane is unfinished.
static bool set_out(Block &b, real start, real span) {
    int open = 0;
    EACH_LANE {
        const real rest = span - b.gone[l], pace = b.pace[l];
        const real own = rest <= pace ? rest : rest < 2 * pace ? rest / 2 : pace;
        b.part[0][l] = start + b.gone[l];
        b.part[1][l] = rest > 0 ? own : span;
        open += rest > 0;
    }
    return open;
}

// LU factors of 1 - g df/dh, by the operations of `Elimination` in elimination.py.
static void eliminate(Block &b) {
    EACH_VECTOR {
        const Vec g = real(DIAGONAL) * AT(b.part[1]);
        for (int e = 0; e < ENTRIES; ++e) {
            const Vec slope = GIVEN[e] < 0 ? Vec{} : Vec(AT(b.by_level[GIVEN[e]]));
            AT(b.factor[e]) = real(ENTRY_ROW[e] == ENTRY_COLUMN[e]) - g * slope;
        }
        for (int n = 0, r = 0, u = 0; n < ORDER; ++n) {
            const Vec inverse = real(1) / AT(b.factor[PIVOT[n]]);
            AT(b.inverse[PIVOT[n]]) = inverse;
            for (; r < ELIMINATIONS && MULTIPLIED[r] == PIVOT[n]; ++r) {
                const Vec multiplier = AT(b.factor[MULTIPLIER[r]]) * inverse;
                AT(b.factor[MULTIPLIER[r]]) = multiplier;
                for (; u < CHANGES_UNTIL[r]; ++u) AT(b.factor[CHANGED[u]]) -= multiplier * AT(b.factor[CHANGED_BY[u]]);
            }
        }
    }
}

static void solve(Block &b, Lane *x) {
    EACH_VECTOR {
        for (int r = 0; r < ELIMINATIONS; ++r)
            AT(x[ENTRY_ROW[MULTIPLIER[r]]]) -= AT(b.factor[MULTIPLIER[r]]) * AT(x[MULTIPLIED[r]]);
        for (int n = ORDER - 1; n >= 0; --n) {
            Vec sum = AT(x[PIVOT[n]]);
            for (int u = n ? BEYOND_UNTIL[n - 1] : 0; u < BEYOND_UNTIL[n]; ++u)
                sum -= AT(b.factor[BEYOND[u]]) * AT(x[ENTRY_COLUMN[BEYOND[u]]]);
            AT(x[PIVOT[n]]) = sum * AT(b.inverse[PIVOT[n]]);
        }
    }
}

// The first `count` slopes, weighted and summed.
static inline Vec weighted(const double *weight, Lane *first, int stride, int count, int l) {
    Vec sum = real(weight[0]) * AT(first[0]);
    for (int j = 1; j < count; ++j) sum += real(weight[j]) * AT(first[j * stride]);
    return sum;
}

// Error estimate of a step.
static inline void error_of(Block &b, Lane out, Lane *first, int stride) {
    EACH_VECTOR AT(out) = FABS(AT(b.part[1]) * weighted(STEP_ERROR, first, stride, STAGES + 1, l));
}

// Solves levels = base + g f(levels) by Newton's method, with as many iterations as each lane needs.
static void solve_stage(const Job &job, Block &b, const real *clock, const real *channel) {
    const real enough = NEWTON_SHARE * job.tolerance;
    Lane active, before;
    EACH_LANE {
        active[l] = 1;
        before[l] = 0;
    }
    for (int round = 0, open = 1; round < NEWTON_ROUNDS && open; ++round) {
        rates(b, clock, channel);
        eliminate(b);
        for (int i = 0; i < ORDER; ++i) EACH_VECTOR {
            const Vec g = real(DIAGONAL) * AT(b.part[1]);
            AT(b.move[i]) = AT(b.base[i]) + g * AT(b.slope[i]) - AT(b.level[i]);
        }
        solve(b, b.move);
        Lane size, rounding;
        EACH_LANE size[l] = rounding[l] = 0;
        for (int i = 0; i < ORDER; ++i) EACH_LANE {
            const real move = std::fabs(b.move[i][l]);
            size[l] = move > size[l] ? move : size[l];
            b.level[i][l] += active[l] != 0 ? b.move[i][l] : 0;
            const real level = NEWTON_ROUNDING * std::numeric_limits<real>::epsilon() * std::fabs(b.level[i][l]);
            rounding[l] = level > rounding[l] ? level : rounding[l];
        }
        open = 0;
        EACH_LANE {
            const bool far = size[l] > enough && size[l] > rounding[l] && !(size[l] * size[l] <= enough * before[l]);
            active[l] = active[l] != 0 && far ? 1 : 0;
            before[l] = size[l];
            open += active[l] != 0;
        }
    }
    EACH_LANE b.failed[l] = active[l] != 0 ? 1 : b.failed[l];
}

// One step of each lane, see step_control.py.
static void step(const Job &job, Block &b, const real *clock, const real *channel) {
    EACH_LANE b.failed[l] = 0;
    take_rates(b, clock, channel, 0);
    for (int s = 1; s <= STAGES; ++s) {
        for (int i = 0; i < ORDER; ++i) EACH_VECTOR {
            const Vec own = AT(b.part[1]);
            AT(b.base[i]) = AT(b.before[i]) + own * weighted(STAGE[s - 1], &b.stage[0][i], ORDER, s, l);
            AT(b.level[i]) = AT(b.base[i]) + real(DIAGONAL) * own * AT(b.stage[s - 1][i]);
        }
        solve_stage(job, b, clock, channel);
        for (int i = 0; i < ORDER; ++i) EACH_VECTOR
            AT(b.stage[s][i]) = (AT(b.level[i]) - AT(b.base[i])) / (real(DIAGONAL) * AT(b.part[1]));
#if TANGENT
        rates(b, clock, channel);
        eliminate(b);
        for (int p = 0; p < COLUMNS; ++p) {
            for (int i = 0; i < ORDER; ++i) EACH_VECTOR {
                const Vec own = AT(b.part[1]);
                const Vec rest = AT(b.d_before[p][i])
                                 + own * weighted(STAGE[s - 1], &b.d_stage[0][p][i], ORDER * COLUMNS, s, l);
                AT(b.base[i]) = rest;
                AT(b.d_level[p][i]) = rest + real(DIAGONAL) * own * AT(b.d_slope[p][i]);
            }
            solve(b, b.d_level[p]);
            for (int i = 0; i < ORDER; ++i) EACH_VECTOR
                AT(b.d_stage[s][p][i]) = (AT(b.d_level[p][i]) - AT(b.base[i])) / (real(DIAGONAL) * AT(b.part[1]));
        }
#endif
    }
    for (int i = 0; i < ORDER; ++i) {
        error_of(b, b.error[i], &b.stage[0][i], ORDER);
#if TANGENT
        for (int p = 0; p < COLUMNS; ++p) error_of(b, b.d_error[p][i], &b.d_stage[0][p][i], ORDER * COLUMNS);
#endif
    }
}

// Keeps a step of a lane if its error is at most the tolerance, or if it is the shortest allowed. The next length follows
// from the error, which grows with step^4; that of slopes counts relative to the largest slope by the parameter so far.
// NaN levels are accepted unchanged.
static void keep_or_undo(const Job &job, Block &b, real span) {
    const real tolerance = job.tolerance, shortest = job.shortest;
    Lane kept, error;
    EACH_LANE {
        real largest = 0;
        for (int i = 0; i < ORDER; ++i) largest = b.error[i][l] > largest ? b.error[i][l] : largest;
        error[l] = b.failed[l] != 0 ? INFINITY : largest / tolerance;
    }
#if TANGENT
    Lane size[COLUMNS];
    for (int p = 0; p < COLUMNS; ++p) EACH_LANE {
        real wrong = 0;
        size[p][l] = b.d_size[p][l];
        for (int i = 0; i < ORDER; ++i) {
            wrong = b.d_error[p][i][l] > wrong ? b.d_error[p][i][l] : wrong;
            size[p][l] = std::fabs(b.d_level[p][i][l]) > size[p][l] ? std::fabs(b.d_level[p][i][l]) : size[p][l];
        }
        const real share = wrong > 0 ? wrong / (real(job.slope_tolerance) * size[p][l]) : 0;
        error[l] = share > error[l] ? share : error[l];
    }
#endif
    EACH_LANE {
        const real own = b.part[1][l], pace = b.pace[l];
        const real cut = std::sqrt(std::sqrt(error[l])) / real(0.9), least = 1 / real(LONGER), most = 1 / real(SHORTER);
        const real reach = own / (cut < least ? least : cut > most ? most : cut);
        const bool is_open = b.gone[l] < span, small = !(error[l] > 1);
        const real next = small && own < pace && reach < pace ? pace : reach;
        kept[l] = is_open && (small || own <= shortest) ? 1 : 0;
        b.pace[l] = !is_open ? pace : next < shortest ? shortest : next;
        b.gone[l] = kept[l] == 0 ? b.gone[l] : span - b.gone[l] <= own ? span : b.gone[l] + own;
    }
    for (int i = 0; i < ORDER; ++i) EACH_LANE b.level[i][l] = kept[l] != 0 ? b.level[i][l] : b.before[i][l];
#if TANGENT
    for (int p = 0; p < COLUMNS; ++p) {
        EACH_LANE b.d_size[p][l] = kept[l] != 0 ? size[p][l] : b.d_size[p][l];
        for (int i = 0; i < ORDER; ++i)
            EACH_LANE b.d_level[p][i][l] = kept[l] != 0 ? b.d_level[p][i][l] : b.d_before[p][i][l];
    }
#endif
}

// A step of the grid, which each lane divides into as many adaptive steps as it needs.
static void step_within(const Job &job, Block &b, const real *clock, const real *channel) {
    act(b, clock, channel);
    EACH_LANE b.gone[l] = 0;
    while (!is_interrupted(b) && set_out(b, clock[0], clock[1])) {
        remember_levels(b);
        step(job, b, clock, channel);
        keep_or_undo(job, b, clock[1]);
    }
}
#endif

static void run_block(const Job &job, Block &b, const Rows &rows) {
    load(job, b, rows);
    prepare(b, nullptr, nullptr);
    begin_with(b.level, job.start, job.start_width, 0, job.start_width, rows);
    for (int64_t k = 0; k < job.steps; ++k) {
        if (is_interrupted(b)) return;
        const real clock[2] = {job.starts[k], job.spans[k]};
        const real *channel = job.means + k * CHANNELS;
        int64_t s = job.first_sample[k];
        const int64_t stop = job.first_sample[k + 1];
        if (LATE_ACTUATORS) look_up_late_channels(job, b, clock[0], clock[1], k == 0);
        if (k == 0) {
            settle_commands(b, clock, channel);
            begin_with(b.command_memory, job.start_memory, MEMORY, 0, COMMAND_MEMORY, rows);
            begin_with(b.level, job.start, job.start_width, 0, job.start_width, rows);
        }
        for (; s < stop && job.sample_shares[s] <= 0; ++s) {
            copy_levels(b, false);
            consume(job, b, rows, s);
        }
#if INNER_SAMPLES
        const bool inner = has_inner_sample(job, k);
        if (inner) remember_levels(b);
#endif
#if WITHIN
        step_within(job, b, clock, channel);
#else
        step(b, clock, channel);
#endif
#if INNER_SAMPLES
        if (inner) end(b, clock, channel);
#endif
        for (; s < stop; ++s) {
            take_sample(b, clock[1], job.sample_shares[s]);
            consume(job, b, rows, s);
        }
    }
    finish(job, b, rows);
}

static void work(const Job &job, std::atomic<int64_t> &next, Watch &watch, bool calls) {
    std::vector<Block> block(1);
    Block &b = block[0];
    b.nominal = job.nominal;
    b.lifted = job.lifted;
    b.resolution = *job.resolution;
    b.watch = &watch;
    b.looks = calls;
    b.history.resize(LATE_SENSORS * job.samples * LANES);
#if TANGENT
    b.d_history.resize(COLUMNS * LATE_SENSORS * job.samples * LANES);
#endif
    for (int64_t first; !watch.stop && (first = LANES * next++) < job.lanes;)
        run_block(job, b, {first, job.lanes - first < LANES ? job.lanes - first : LANES});
}

// The results are written once, in full; large pages need 1/500 of the page faults of small ones.
static void prefer_large_pages(void *from, int64_t bytes) {
#if defined(__linux__)
    const uintptr_t page = 1 << 21, begin = (reinterpret_cast<uintptr_t>(from) + page - 1) / page * page;
    const uintptr_t end = (reinterpret_cast<uintptr_t>(from) + bytes) / page * page;
    if (end > begin) madvise(reinterpret_cast<void *>(begin), end - begin, MADV_HUGEPAGE);
#endif
}

// Called with Python's lock held. After an interruption an exception is set, and the results are incomplete.
extern "C" void run(const Job *job) {
    Watch watch(job->python);
    prefer_large_pages(job->out, job->out_bytes);
    prefer_large_pages(job->jacobian, job->jacobian_bytes);
    std::atomic<int64_t> next(0);
    const int64_t blocks = (job->lanes + LANES - 1) / LANES;
    const int64_t threads = job->threads < blocks ? job->threads : blocks;
    std::atomic<int64_t> at_work(threads - 1);
    std::vector<std::thread> others;
    for (int64_t i = 1; i < threads; ++i)
        others.emplace_back([&] {
            work(*job, next, watch, false);
            --at_work;
        });
    work(*job, next, watch, true);
    while (at_work > 0) {
        std::this_thread::sleep_for(std::chrono::microseconds(50));
        watch.look();
    }
    for (auto &other : others) other.join();
}
