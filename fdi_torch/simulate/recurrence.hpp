// Linear recurrences in time, lane by lane. Time is the last dimension in memory; a few steps at a time are transposed
// into a block, processed there, and transposed back. Compiled for one number of TANKS.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

namespace {
constexpr int64_t BLOCK = 64;

// rows (count, stride) from `first` on -> block[t][row]; and back, from the first `count` of `each` in a block's step.
inline void gather(const double* rows, int64_t count, int64_t stride, int64_t first, int64_t length, double* block) {
    for (int64_t r = 0; r < count; ++r) {
        const double* row = rows + r * stride + first;
        for (int64_t t = 0; t < length; ++t) block[t * count + r] = row[t];
    }
}

inline void scatter(const double* block, int64_t each, int64_t count, int64_t stride, int64_t first, int64_t length,
                    double* rows) {
    for (int64_t r = 0; r < count; ++r) {
        double* row = rows + r * stride + first;
        for (int64_t t = 0; t < length; ++t) row[t] = block[t * each + r];
    }
}

// to (N, W) += A from, of `from` the rows that are not all zero.
template <int N, int W>
inline void add_product(const double* __restrict a, const double* __restrict from, const bool* __restrict on,
                        double* __restrict to) {
    for (int i = 0; i < N; ++i) {
        double total[W];
        for (int c = 0; c < W; ++c) total[c] = to[i * W + c];
        for (int j = 0; j < N; ++j) {
            if (!on[j]) continue;
            const double value = a[i * N + j];
            for (int c = 0; c < W; ++c) total[c] += value * from[j * W + c];
        }
        for (int c = 0; c < W; ++c) to[i * W + c] = total[c];
    }
}

// Columns of eight, of any alignment.
typedef double Eights __attribute__((vector_size(8 * sizeof(double)), aligned(sizeof(double)), may_alias));
constexpr int64_t EIGHT = 8;

// to = A from + to, columns side by side in groups of eight.
template <int N>
inline void step(const double* __restrict a, const double* __restrict from, int64_t columns, double* __restrict to) {
    for (int64_t c = 0; c < columns; c += EIGHT)
        for (int i = 0; i < N; ++i) {
            Eights total = *reinterpret_cast<const Eights*>(to + i * columns + c);
            for (int j = 0; j < N; ++j) total += a[i * N + j] * *reinterpret_cast<const Eights*>(from + j * columns + c);
            *reinterpret_cast<Eights*>(to + i * columns + c) = total;
        }
}

// A block of steps of several rows, time last: row r lies at r * BLOCK.
typedef double Steps[BLOCK];

inline bool any(const double* row, int64_t length) {
    return std::any_of(row, row + length, [](double x) { return x != 0.0; });
}

// to += factor x, at all steps of a block.
inline void add_scaled(const Steps& factor, const double* x, int64_t length, Steps& to) {
    for (int64_t t = 0; t < length; ++t) to[t] += factor[t] * x[t];
}

// Inverses of N x N matrices by elimination without pivots, at all steps of a block side by side. on (N, N): which
// elements of m are nonzero at some step; on return, those of the inverse.
template <int N>
inline void invert(Steps* m, Steps* inverse, bool* on) {
    bool reached[N * N] = {};
    std::fill(&inverse[0][0], &inverse[0][0] + N * N * BLOCK, 0.0);
    for (int i = 0; i < N; ++i) std::fill(inverse[i * N + i], inverse[i * N + i] + BLOCK, 1.0), reached[i * N + i] = true;
    for (int i = 0; i < N; ++i) {
        Steps scale;
        for (int64_t t = 0; t < BLOCK; ++t) scale[t] = 1.0 / m[i * N + i][t];
        for (int j = 0; j < N; ++j)
            for (auto [matrix, full] : {std::pair(m, on), std::pair(inverse, reached)})
                if (full[i * N + j])
                    for (int64_t t = 0; t < BLOCK; ++t) matrix[i * N + j][t] *= scale[t];
        for (int k = 0; k < N; ++k) {
            if (k == i || !on[k * N + i]) continue;
            Steps factor;
            for (int64_t t = 0; t < BLOCK; ++t) factor[t] = -m[k * N + i][t];
            for (int j = 0; j < N; ++j)
                for (auto [matrix, full] : {std::pair(m, on), std::pair(inverse, reached)})
                    if (full[i * N + j]) {
                        add_scaled(factor, matrix[i * N + j], BLOCK, matrix[k * N + j]);
                        full[k * N + j] = true;
                    }
        }
    }
    std::copy(reached, reached + N * N, on);
}

// A linear recurrence of one lane, as in `scan`, for W columns from `from` on, of which the last may not be there.
template <int N, int W>
void scan_columns(int64_t steps, int64_t columns, int64_t from, const double* a, const double* gain, const double* b,
                  const double* first, double* x) {
    const int64_t width = std::min<int64_t>(W, columns - from);
    std::vector<double> along(2 * BLOCK * N * N), forcing(BLOCK * N * W), path((BLOCK + 1) * N * W);
    double* gains = along.data() + BLOCK * N * N;
    bool all[N], on[N];
    std::fill(all, all + N, true);
    for (int i = 0; i < N; ++i)
        for (int64_t c = 0; c < width; ++c) {
            const int64_t row = i * columns + from + c;
            x[row * (steps + 1)] = path[i * W + c] = first[row];
        }
    for (int64_t k = 0; k < steps; k += BLOCK) {
        const int64_t length = std::min(BLOCK, steps - k);
        gather(a, N * N, steps, k, length, along.data());
        if (gain) gather(gain, N * N, steps, k, length, gains);
        for (int i = 0; i < N; ++i) {
            on[i] = false;
            for (int64_t c = 0; c < width; ++c) {
                const double* row = b + (i * columns + from + c) * steps + k;
                for (int64_t t = 0; t < length; ++t) {
                    forcing[(t * N + i) * W + c] = row[t];
                    on[i] |= row[t] != 0.0;
                }
            }
        }
        for (int64_t t = 0; t < length; ++t) {
            double *now = &path[t * N * W], *next = now + N * W;
            const double* pushed = &forcing[t * N * W];
            if (gain) {
                std::fill(next, next + N * W, 0.0);
                add_product<N, W>(gains + t * N * N, pushed, on, next);
            } else {
                std::copy(pushed, pushed + N * W, next);
            }
            add_product<N, W>(&along[t * N * N], now, all, next);
        }
        for (int i = 0; i < N; ++i)
            for (int64_t c = 0; c < width; ++c) {
                double* row = x + (i * columns + from + c) * (steps + 1) + k + 1;
                for (int64_t t = 0; t < length; ++t) row[t] = path[((t + 1) * N + i) * W + c];
            }
        std::copy(&path[length * N * W], &path[(length + 1) * N * W], path.begin());
    }
}

// x_{k+1} = A_k x_k + G_k b_k: a, gain (lanes, N, N, steps), gain null for the unit matrix; b (lanes, N, columns, steps),
// first (lanes, N, columns) -> x (lanes, N, columns, steps + 1).
template <int N>
void scan(int64_t lanes, int64_t steps, int64_t columns, const double* a, const double* gain, const double* b,
          const double* first, double* x) {
    for (int64_t lane = 0; lane < lanes; ++lane) {
        const int64_t square = lane * N * N * steps, wide = lane * N * columns;
        const double *own_a = a + square, *own_gain = gain ? gain + square : nullptr, *own_b = b + wide * steps;
        double* own_x = x + wide * (steps + 1);
        for (int64_t from = 0; from < columns;) {
            const int64_t left = columns - from;
            auto* run = left > 4 ? scan_columns<N, 16> : left > 1 ? scan_columns<N, 4> : scan_columns<N, 1>;
            run(steps, columns, from, own_a, own_gain, own_b, first + wide, own_x);
            from += left > 4 ? 16 : left > 1 ? 4 : 1;
        }
    }
}

// Newton's correction of a path (lanes, N, steps + 1) under the implicit midpoint rule, and its slopes by parameters:
// span (steps), rates (lanes, N, steps), by_level (lanes, N, N, steps), by_theta (lanes, N, columns, steps),
// start (lanes, N), start_slopes (lanes, N, columns) -> levels like path, slopes (lanes, N, columns, steps + 1),
// transition and gain (lanes, N, N, steps), both or none, defect (lanes).
template <int N>
void midpoint(int64_t lanes, int64_t steps, int64_t columns, const double* span, const double* path,
              const double* rates, const double* by_level, const double* by_theta, const double* start,
              const double* start_slopes, double* levels, double* slopes, double* transition, double* gain,
              double* defect) {
    // The correction of the levels is the first of the columns, before the slopes; the last ones may be padding.
    const int64_t width = (columns + EIGHT) / EIGHT * EIGHT, wide = N * width;
    std::vector<double> moved((BLOCK + 1) * wide);
    double move[BLOCK * N * N];
    Steps matrix[N * N], inverse[N * N], half, misfit[N];
    for (int i = 0; i < N * N; ++i)
        for (int64_t t = 0; t < BLOCK; ++t) matrix[i][t] = i % (N + 1) == 0;
    for (int64_t lane = 0; lane < lanes; ++lane) {
        const double* own_path = path + lane * N * (steps + 1);
        const double *own_rates = rates + lane * N * steps, *own_by_level = by_level + lane * N * N * steps;
        const double* own_by_theta = by_theta + lane * N * columns * steps;
        double *own_levels = levels + lane * N * (steps + 1), *own_slopes = slopes + lane * N * columns * (steps + 1);
        double largest = 0.0;
        bool broken = false;
        // The corrections and slopes after step t of the block, from the first of its nodes that is not yet written.
        const auto write = [&](int64_t node, int64_t t, int64_t length) {
            for (int i = 0; i < N; ++i) {
                for (int64_t s = 0; s < length; ++s) {
                    const double own = moved[(t + s) * wide + i * width];
                    largest = std::max(largest, std::fabs(own));
                    broken |= std::isnan(own);
                    own_levels[i * (steps + 1) + node + s] = own_path[i * (steps + 1) + node + s] + own;
                }
                double* to = own_slopes + i * columns * (steps + 1);
                scatter(&moved[t * wide + i * width + 1], wide, columns, steps + 1, node, length, to);
            }
        };
        for (int i = 0; i < N; ++i) {
            moved[i * width] = start[lane * N + i] - own_path[i * (steps + 1)];
            for (int64_t c = 0; c < columns; ++c)
                moved[i * width + 1 + c] = start_slopes[(lane * N + i) * columns + c];
        }
        write(0, 0, 1);
        for (int64_t k = 0; k < steps; k += BLOCK) {
            const int64_t length = std::min(BLOCK, steps - k);
            bool on[N * N];
            for (int64_t t = 0; t < length; ++t) half[t] = 0.5 * span[k + t];
            for (int i = 0; i < N * N; ++i) {
                const double* by = own_by_level + i * steps + k;
                on[i] = i % (N + 1) == 0 || any(by, length);
                for (int64_t t = 0; t < length; ++t) matrix[i][t] = (i % (N + 1) == 0) - half[t] * by[t];
            }
            invert<N>(matrix, inverse, on);
            for (int i = 0; i < N; ++i) {
                const double *at = own_path + i * (steps + 1) + k, *rate = own_rates + i * steps + k;
                for (int64_t t = 0; t < length; ++t) misfit[i][t] = 2.0 * half[t] * rate[t] - (at[t + 1] - at[t]);
            }
            for (int i = 0; i < N * N; ++i) {
                for (int64_t t = 0; t < length; ++t) move[t * N * N + i] = 2.0 * inverse[i][t] - (i % (N + 1) == 0);
                if (!transition) continue;
                double *to = transition + (lane * N * N + i) * steps + k, *reach = gain + (lane * N * N + i) * steps + k;
                for (int64_t t = 0; t < length; ++t) {
                    to[t] = 2.0 * inverse[i][t] - (i % (N + 1) == 0);
                    reach[t] = 2.0 * half[t] * inverse[i][t];
                }
            }
            for (int64_t c = -1; c < columns; ++c) {
                Steps total[N] = {};
                for (int j = 0; j < N; ++j) {
                    const double* by = c < 0 ? misfit[j] : own_by_theta + (j * columns + c) * steps + k;
                    if (!any(by, length)) continue;
                    Steps pushed;
                    for (int64_t t = 0; t < length; ++t) pushed[t] = (c < 0 ? 1.0 : 2.0 * half[t]) * by[t];
                    for (int i = 0; i < N; ++i)
                        if (on[i * N + j]) add_scaled(inverse[i * N + j], pushed, length, total[i]);
                }
                for (int i = 0; i < N; ++i)
                    for (int64_t t = 0; t < length; ++t) moved[(t + 1) * wide + i * width + 1 + c] = total[i][t];
            }
            for (int64_t t = 0; t < length; ++t)
                step<N>(&move[t * N * N], &moved[t * wide], width, &moved[(t + 1) * wide]);
            write(k + 1, 1, length);
            std::copy(&moved[length * wide], &moved[length * wide] + wide, moved.begin());
        }
        defect[lane] = broken ? std::nan("") : largest;
    }
}
}  // namespace

extern "C" void scan_in_time(int64_t lanes, int64_t steps, int64_t columns, const double* a, const double* gain,
                             const double* b, const double* first, double* x) {
    scan<TANKS>(lanes, steps, columns, a, gain, b, first, x);
}

extern "C" void midpoint_step(int64_t lanes, int64_t steps, int64_t columns, const double* span, const double* path,
                              const double* rates, const double* by_level, const double* by_theta, const double* start,
                              const double* start_slopes, double* levels, double* slopes, double* transition,
                              double* gain, double* defect) {
    midpoint<TANKS>(lanes, steps, columns, span, path, rates, by_level, by_theta, start, start_slopes, levels, slopes,
                    transition, gain, defect);
}
