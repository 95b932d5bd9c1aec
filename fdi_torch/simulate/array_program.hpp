// Straight-line code on arrays in time, interpreted block by block: each instruction acts on all steps of a block, in
// registers of BLOCK numbers. A block's registers fit into the processor's cache, which temporary arrays of all steps
// would not.
#include <algorithm>
#include <cmath>
#include <vector>

struct alignas(64) Register {
    double of_step[BLOCK];
};

struct Instruction {
    int32_t operation, out, a, b, c;
};

static void carry_out(const Instruction* code, int64_t count, Register* registers) {
    for (int64_t i = 0; i < count; ++i) {
        const Instruction& now = code[i];
        double* out = registers[now.out].of_step;
        double *a = registers[now.a].of_step, *b = registers[now.b].of_step, *c = registers[now.c].of_step;
        switch (now.operation) {
            //@OPERATIONS@
        }
    }
}

// values (lanes, scalars): numbers of one lane, each of which fills a register. inputs, outputs: arrays in time, each with
// its own stride between lanes. fixed_code: what does not vary in time, once per lane. varying_code: the rest, once per
// block. An output is stored as soon as its position comes: `stores` holds the number of instructions of `varying_code`
// after which each is complete.
struct Program {
    int64_t registers, scalars, inputs, outputs, fixed, varying;
    const double* values;
    const int32_t *scalar_registers, *input_registers, *output_registers;
    const Instruction *fixed_code, *varying_code;
    const int64_t* stores;
    double* const* input_starts;
    const int64_t* input_strides;
    double* const* output_starts;
    const int64_t* output_strides;
};

static void carry_out_fixed(const Program& x, int64_t lane, Register* registers) {
    for (int64_t i = 0; i < x.scalars; ++i) {
        double* to = registers[x.scalar_registers[i]].of_step;
        std::fill(to, to + BLOCK, x.values[lane * x.scalars + i]);
    }
    carry_out(x.fixed_code, x.fixed, registers);
}

static void carry_out_block(const Program& x, int64_t lane, int64_t start, int64_t length, Register* registers) {
    for (int64_t i = 0; i < x.inputs; ++i) {
        const double* from = x.input_starts[i] + lane * x.input_strides[i] + start;
        std::copy(from, from + length, registers[x.input_registers[i]].of_step);
    }
    int64_t done = 0;
    for (int64_t i = 0; i < x.outputs; ++i) {
        carry_out(x.varying_code + done, x.stores[i] - done, registers);
        done = x.stores[i];
        const double* from = registers[x.output_registers[i]].of_step;
        std::copy(from, from + length, x.output_starts[i] + lane * x.output_strides[i] + start);
    }
}

extern "C" void run_on_arrays(int64_t lanes, int64_t steps, const Program* program) {
    std::vector<Register> registers(program->registers);
    for (int64_t lane = 0; lane < lanes; ++lane) {
        carry_out_fixed(*program, lane, registers.data());
        for (int64_t start = 0; start < steps; start += BLOCK)
            carry_out_block(*program, lane, start, std::min<int64_t>(BLOCK, steps - start), registers.data());
    }
}

// m x = x in place, m (n, n), by elimination without pivots, which skips zeros.
static void solve(int64_t n, double* m, double* x) {
    for (int64_t i = 0; i < n; ++i)
        for (int64_t k = i + 1; k < n; ++k) {
            if (m[k * n + i] == 0.0) continue;
            const double factor = m[k * n + i] / m[i * n + i];
            for (int64_t j = i + 1; j < n; ++j) m[k * n + j] -= factor * m[i * n + j];
            x[k] -= factor * x[i];
        }
    for (int64_t i = n; i-- > 0;) {
        for (int64_t j = i + 1; j < n; ++j) x[i] -= m[i * n + j] * x[j];
        x[i] /= m[i * n + i];
    }
}

// States under the implicit midpoint rule. The program computes rates (n, steps) and then the slopes (count, steps) of
// rate rows[e] by state columns[e] from the states `middle` (n, steps) in the middle of each step; all lanes share these.
struct Trajectory {
    int64_t lanes, n, steps, count;
    const int64_t *rows, *columns;
    const double *span, *rates, *slopes;
    double *middle, *path; // path (lanes, n, steps + 1)
};

// One correction by Newton's method of the steps from `first` to `last`, of which a share is taken; returns the largest,
// or NaN.
static double correct(const Program& program, const Trajectory& x, int64_t lane, int64_t first, int64_t last,
                      double share, Register* registers) {
    const int64_t n = x.n;
    double* path = x.path + lane * n * (x.steps + 1);
    for (int64_t i = 0; i < n; ++i) {
        const double* levels = path + i * (x.steps + 1);
        for (int64_t t = first; t < last; ++t) x.middle[i * x.steps + t] = 0.5 * (levels[t] + levels[t + 1]);
    }
    carry_out_block(program, lane, first, last - first, registers);
    std::vector<double> matrix(n * n), right(n), change(n), before(n);
    double largest = 0.0;
    for (int64_t i = 0; i < n; ++i) before[i] = path[i * (x.steps + 1) + first];
    for (int64_t t = first; t < last; ++t) {
        std::fill(matrix.begin(), matrix.end(), 0.0);
        for (int64_t i = 0; i < n; ++i) {
            const double level = path[i * (x.steps + 1) + t + 1];
            matrix[i * n + i] = 1.0;
            right[i] = change[i] + x.span[t] * x.rates[i * x.steps + t] - (level - before[i]);
            before[i] = level;
        }
        for (int64_t e = 0; e < x.count; ++e) {
            const double slope = 0.5 * x.span[t] * x.slopes[e * x.steps + t];
            matrix[x.rows[e] * n + x.columns[e]] -= slope;
            right[x.rows[e]] += slope * change[x.columns[e]];
        }
        solve(n, matrix.data(), right.data());
        change.swap(right);
        for (int64_t i = 0; i < n; ++i) {
            path[i * (x.steps + 1) + t + 1] += share * change[i];
            if (!(std::fabs(change[i]) <= largest)) largest = std::fabs(change[i]);
            if (std::isnan(largest)) return largest;
        }
    }
    return largest;
}

// The trajectories from the first state of each lane in `path`, by Newton's method on one block of steps after the other.
// A block starts from what `path` holds, if that is a guess, and then from the constant state at its start. If neither
// converges within `rounds`, the block is halved: at the kink of a rim or a floor, the slopes on one side of it would
// hold for all later steps. In a single step, Newton's method may jump from one side of a kink to the other for ever,
// unless it takes smaller and smaller shares of its corrections.
extern "C" void solve_trajectories(const Program* program, const Trajectory* trajectory, int64_t guessed,
                                   double tolerance, int64_t rounds) {
    const Trajectory& x = *trajectory;
    std::vector<Register> space(program->registers);
    Register* registers = space.data();
    for (int64_t lane = 0; lane < x.lanes; ++lane) {
        carry_out_fixed(*program, lane, registers);
        bool constant = !guessed;
        for (int64_t first = 0, length = BLOCK; first < x.steps;) {
            const int64_t last = std::min(first + length, x.steps);
            for (int64_t i = 0; i < x.n && constant; ++i) {
                double* levels = x.path + (lane * x.n + i) * (x.steps + 1);
                std::fill(levels + first + 1, levels + last + 1, levels[first]);
            }
            bool converged = false;
            for (int64_t round = 0; round < rounds && !converged; ++round)
                converged = correct(*program, x, lane, first, last, 1.0, registers) < tolerance;
            for (double share = 0.5; share > 1e-3 && !converged && last - first == 1; share *= 0.5)
                for (int64_t round = 0; round < rounds && !converged; ++round)
                    converged = correct(*program, x, lane, first, last, share, registers) < tolerance;
            if (!converged && (!constant || last - first > 1)) {
                if (constant) length = (last - first) / 2;
                constant = true;
                continue;
            }
            first = last;
            length = std::min<int64_t>(2 * length, BLOCK);
            constant = !guessed;
        }
    }
}
