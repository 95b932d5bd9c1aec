// Straight-line code on arrays in time, interpreted block by block: each instruction acts on all steps of a block, in
// registers of BLOCK numbers. A block's registers fit into the processor's cache, which temporary arrays of all steps
// would not.
#include <algorithm>
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
extern "C" void run_on_arrays(int64_t lanes, int64_t steps, int64_t count, const Scalars* scalars, const Arrays* inputs,
                              const Code* fixed, const Code* varying, const int64_t* stores, const Arrays* outputs) {
    std::vector<Register> space(count);
    Register* registers = space.data();
    for (int64_t lane = 0; lane < lanes; ++lane) {
        for (int64_t i = 0; i < scalars->count; ++i) {
            double* to = registers[scalars->registers[i]].of_step;
            std::fill(to, to + BLOCK, scalars->values[lane * scalars->stride + i]);
        }
        carry_out(*fixed, registers);
        for (int64_t start = 0; start < steps; start += BLOCK) {
            const int64_t length = std::min<int64_t>(BLOCK, steps - start);
            for (int64_t i = 0; i < inputs->count; ++i) {
                const double* from = inputs->starts[i] + lane * inputs->strides[i] + start;
                std::copy(from, from + length, registers[inputs->registers[i]].of_step);
            }
            int64_t done = 0;
            for (int64_t i = 0; i < outputs->count; ++i) {
                carry_out({stores[i] - done, varying->instructions + done}, registers);
                done = stores[i];
                const double* from = registers[outputs->registers[i]].of_step;
                std::copy(from, from + length, outputs->starts[i] + lane * outputs->strides[i] + start);
            }
        }
    }
}
