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

struct Code {
    int64_t count;
    const Instruction* instructions;
};

// Numbers of one lane, (lanes, count) with `stride` between lanes: each fills a register.
struct Scalars {
    int64_t count, stride;
    const double* values;
    const int32_t* registers;
};

// Arrays in time, each with its own stride between lanes.
struct Arrays {
    int64_t count;
    double* const* starts;
    const int64_t* strides;
    const int32_t* registers;
};

static void carry_out(const Code& code, Register* registers) {
    for (int64_t i = 0; i < code.count; ++i) {
        const Instruction& now = code.instructions[i];
        double* out = registers[now.out].of_step;
        double *a = registers[now.a].of_step, *b = registers[now.b].of_step, *c = registers[now.c].of_step;
        switch (now.operation) {
            //@OPERATIONS@
        }
    }
}

// fixed: what does not vary in time, once per lane. varying: the rest, once per block. An output is stored as soon as
// its position in `outputs` comes: `stores` holds the number of instructions of `varying` after which each is complete.
struct Program {
    int64_t registers;
    Scalars scalars;
    Arrays inputs;
    Code fixed, varying;
    const int64_t* stores;
    Arrays outputs;
};

static void carry_out_fixed(const Program& program, int64_t lane, Register* registers) {
    const Scalars& scalars = program.scalars;
    for (int64_t i = 0; i < scalars.count; ++i) {
        double* to = registers[scalars.registers[i]].of_step;
        std::fill(to, to + BLOCK, scalars.values[lane * scalars.stride + i]);
    }
    carry_out(program.fixed, registers);
}

static void carry_out_block(const Program& program, int64_t lane, int64_t start, int64_t length, Register* registers) {
    const Arrays &inputs = program.inputs, &outputs = program.outputs;
    for (int64_t i = 0; i < inputs.count; ++i) {
        const double* from = inputs.starts[i] + lane * inputs.strides[i] + start;
        std::copy(from, from + length, registers[inputs.registers[i]].of_step);
    }
    int64_t done = 0;
    for (int64_t i = 0; i < outputs.count; ++i) {
        carry_out({program.stores[i] - done, program.varying.instructions + done}, registers);
        done = program.stores[i];
        const double* from = registers[outputs.registers[i]].of_step;
        std::copy(from, from + length, outputs.starts[i] + lane * outputs.strides[i] + start);
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

// L U of n x n matrices with the same nonzero elements, at all steps of a block side by side; by elimination without
// pivots, which leaves out what is zero at every step.
struct Elimination {
    struct Pair {
        int64_t row, column;
    };
    int64_t n;
    std::vector<char> on;           // (n, n): elements of L and U that are not zero
    std::vector<Pair> lower, upper; // in the order of the substitutions
    std::vector<Register> m;        // (n, n): L below the diagonal, 1 / U on it, U above
    std::vector<double> of_step;    // the same elements in the order of the substitutions, (BLOCK, lower + upper + n)

    Elimination(int64_t n, int64_t count, const int64_t* rows, const int64_t* columns) : n(n), on(n * n), m(n * n) {
        for (int64_t i = 0; i < n; ++i) on[i * n + i] = true;
        for (int64_t e = 0; e < count; ++e) on[rows[e] * n + columns[e]] = true;
        for (int64_t i = 0; i < n; ++i)
            for (int64_t k = i + 1; k < n; ++k) {
                if (!on[k * n + i]) continue;
                lower.push_back({k, i});
                for (int64_t j = i + 1; j < n; ++j) on[k * n + j] |= on[i * n + j];
            }
        for (int64_t i = n; i-- > 0;)
            for (int64_t j = i + 1; j < n; ++j)
                if (on[i * n + j]) upper.push_back({i, j});
        of_step.resize(BLOCK * width());
    }

    int64_t width() const { return static_cast<int64_t>(lower.size() + upper.size()) + n; }

    void set_to_identity() {
        for (int64_t i = 0; i < n * n; ++i)
            if (on[i]) std::fill(m[i].of_step, m[i].of_step + BLOCK, i % (n + 1) == 0);
    }

    void factorise(int64_t length) {
        for (int64_t i = 0; i < n; ++i) {
            double* pivot = m[i * n + i].of_step;
            for (int64_t t = 0; t < length; ++t) pivot[t] = 1.0 / pivot[t];
            for (int64_t k = i + 1; k < n; ++k) {
                if (!on[k * n + i]) continue;
                double* factor = m[k * n + i].of_step;
                for (int64_t t = 0; t < length; ++t) factor[t] *= pivot[t];
                for (int64_t j = i + 1; j < n; ++j) {
                    if (!on[i * n + j]) continue;
                    const double* from = m[i * n + j].of_step;
                    double* to = m[k * n + j].of_step;
                    for (int64_t t = 0; t < length; ++t) to[t] -= factor[t] * from[t];
                }
            }
        }
        int64_t place = 0;
        const auto store = [&](int64_t row, int64_t column) {
            const double* element = m[row * n + column].of_step;
            for (int64_t t = 0; t < length; ++t) of_step[t * width() + place] = element[t];
            ++place;
        };
        for (const Pair& at : lower) store(at.row, at.column);
        for (const Pair& at : upper) store(at.row, at.column);
        for (int64_t i = 0; i < n; ++i) store(i, i);
    }

    // x (n), a right side, becomes the solution with the matrix of step t.
    void solve(int64_t t, double* x) const {
        const double* element = &of_step[t * width()];
        for (const Pair& at : lower) x[at.row] -= *element++ * x[at.column];
        const double* inverse = element + upper.size();
        auto above = upper.begin();
        for (int64_t i = n; i-- > 0;) {
            for (; above != upper.end() && above->row == i; ++above) x[i] -= *element++ * x[above->column];
            x[i] *= inverse[i];
        }
    }
};

// States under the implicit midpoint rule. The program computes rates (n, steps) and then the slopes (count, steps) of
// rate rows[e] by state columns[e] from the states `middle` (n, steps) in the middle of each step; all lanes share these.
struct Trajectory {
    int64_t lanes, n, steps, count;
    const int64_t *rows, *columns;
    const double *span, *rates, *slopes;
    double *middle, *path; // path (lanes, n, steps + 1)
};

// One correction by Newton's method of the steps from `first` to `last`, of which a share is taken; returns the largest,
// or NaN. With D = 1 - span slopes / 2, the correction c of a node follows from that of the node before, b, and from the
// defect r of the step between them by D c = (2 - D) b + r, so that D (c + b) = 2 b + r.
static double correct(const Program& program, const Trajectory& x, int64_t lane, int64_t first, int64_t last,
                      double share, Register* registers, Elimination& matrices) {
    const int64_t n = x.n, length = last - first;
    double* path = x.path + lane * n * (x.steps + 1);
    for (int64_t i = 0; i < n; ++i) {
        const double* levels = path + i * (x.steps + 1);
        for (int64_t t = first; t < last; ++t) x.middle[i * x.steps + t] = 0.5 * (levels[t] + levels[t + 1]);
    }
    carry_out_block(program, lane, first, length, registers);
    matrices.set_to_identity();
    for (int64_t e = 0; e < x.count; ++e) {
        double* element = matrices.m[x.rows[e] * n + x.columns[e]].of_step;
        const double *slopes = x.slopes + e * x.steps + first, *span = x.span + first;
        for (int64_t t = 0; t < length; ++t) element[t] -= 0.5 * span[t] * slopes[t];
    }
    matrices.factorise(length);
    std::vector<double> defect(length * n), change(n), sum(n);
    for (int64_t i = 0; i < n; ++i) {
        const double *levels = path + i * (x.steps + 1) + first, *rates = x.rates + i * x.steps + first;
        for (int64_t t = 0; t < length; ++t)
            defect[t * n + i] = x.span[first + t] * rates[t] - (levels[t + 1] - levels[t]);
    }
    double largest = 0.0;
    for (int64_t t = 0; t < length; ++t) {
        for (int64_t i = 0; i < n; ++i) sum[i] = 2.0 * change[i] + defect[t * n + i];
        matrices.solve(t, sum.data());
        for (int64_t i = 0; i < n; ++i) {
            change[i] = sum[i] - change[i];
            path[i * (x.steps + 1) + first + t + 1] += share * change[i];
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
    Elimination matrices(x.n, x.count, x.rows, x.columns);
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
                converged = correct(*program, x, lane, first, last, 1.0, registers, matrices) < tolerance;
            for (double share = 0.5; share > 1e-3 && !converged && last - first == 1; share *= 0.5)
                for (int64_t round = 0; round < rounds && !converged; ++round)
                    converged = correct(*program, x, lane, first, last, share, registers, matrices) < tolerance;
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
