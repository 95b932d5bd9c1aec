// Linear recurrences in time, lane by lane: time is the last dimension in memory, and a few of its steps are turned
// into a block that lies close together, worked through, and turned back.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {
constexpr int64_t BLOCK = 64;

// rows (count, stride) from `first` on -> block[t][row]; and back.
inline void gather(const double* rows, int64_t count, int64_t stride, int64_t first, int64_t length, double* block) {
    for (int64_t r = 0; r < count; ++r) {
        const double* row = rows + r * stride + first;
        for (int64_t t = 0; t < length; ++t) block[t * count + r] = row[t];
    }
}

inline void scatter(const double* block, int64_t count, int64_t stride, int64_t first, int64_t length, double* rows) {
    for (int64_t r = 0; r < count; ++r) {
        double* row = rows + r * stride + first;
        for (int64_t t = 0; t < length; ++t) row[t] = block[t * count + r];
    }
}

// to = A from + b, columns side by side.
template <int N>
inline void step(const double* __restrict a, const double* __restrict from, const double* __restrict b,
                 int64_t columns, double* __restrict to) {
    for (int i = 0; i < N; ++i)
        for (int64_t c = 0; c < columns; ++c) {
            double total = b[i * columns + c];
            for (int j = 0; j < N; ++j) total += a[i * N + j] * from[j * columns + c];
            to[i * columns + c] = total;
        }
}

// A block of steps of several rows, time last: row r lies at r * BLOCK.
typedef double Steps[BLOCK];

// Inverses of N x N matrices by elimination without pivots, at all steps of a block side by side.
template <int N>
inline void invert(Steps* m, Steps* inverse) {
    for (int i = 0; i < N; ++i)
        for (int j = 0; j < N; ++j)
            for (int64_t t = 0; t < BLOCK; ++t) inverse[i * N + j][t] = i == j;
    for (int i = 0; i < N; ++i) {
        Steps scale;
        for (int64_t t = 0; t < BLOCK; ++t) scale[t] = 1.0 / m[i * N + i][t];
        for (int j = 0; j < N; ++j)
            for (int64_t t = 0; t < BLOCK; ++t) m[i * N + j][t] *= scale[t], inverse[i * N + j][t] *= scale[t];
        for (int k = 0; k < N; ++k) {
            if (k == i) continue;
            Steps factor;
            for (int64_t t = 0; t < BLOCK; ++t) factor[t] = m[k * N + i][t];
            for (int j = 0; j < N; ++j)
                for (int64_t t = 0; t < BLOCK; ++t) {
                    m[k * N + j][t] -= factor[t] * m[i * N + j][t];
                    inverse[k * N + j][t] -= factor[t] * inverse[i * N + j][t];
                }
        }
    }
}

// x_{k+1} = A_k x_k + b_k: a (lanes, N, N, steps), b (lanes, N, columns, steps), first (lanes, N, columns)
// -> x (lanes, N, columns, steps + 1).
template <int N>
void scan(int64_t lanes, int64_t steps, int64_t columns, const double* a, const double* b, const double* first,
          double* x) {
    const int64_t wide = N * columns;
    std::vector<double> forcing(BLOCK * wide), path((BLOCK + 1) * wide), along(BLOCK * N * N);
    for (int64_t lane = 0; lane < lanes; ++lane) {
        const double *own_a = a + lane * N * N * steps, *own_b = b + lane * wide * steps;
        double* own_x = x + lane * wide * (steps + 1);
        std::copy(first + lane * wide, first + (lane + 1) * wide, path.begin());
        scatter(path.data(), wide, steps + 1, 0, 1, own_x);
        for (int64_t k = 0; k < steps; k += BLOCK) {
            const int64_t length = std::min(BLOCK, steps - k);
            gather(own_a, N * N, steps, k, length, along.data());
            gather(own_b, wide, steps, k, length, forcing.data());
            for (int64_t t = 0; t < length; ++t)
                step<N>(&along[t * N * N], &path[t * wide], &forcing[t * wide], columns, &path[(t + 1) * wide]);
            scatter(&path[wide], wide, steps + 1, k + 1, length, own_x);
            std::copy(&path[length * wide], &path[length * wide] + wide, path.begin());
        }
    }
}

// Newton's correction of a path (lanes, N, steps + 1) under the implicit midpoint rule, and its slopes by parameters:
// span (steps), rates (lanes, N, steps), by_level (lanes, N, N, steps), by_theta (lanes, N, columns, steps),
// start (lanes, N), start_slopes (lanes, N, columns) -> levels like path, slopes (lanes, N, columns, steps + 1),
// transition and gain (lanes, N, N, steps), defect (lanes).
template <int N>
void midpoint(int64_t lanes, int64_t steps, int64_t columns, const double* span, const double* path,
              const double* rates, const double* by_level, const double* by_theta, const double* start,
              const double* start_slopes, double* levels, double* slopes, double* transition, double* gain,
              double* defect) {
    const int64_t wide = N * columns;
    std::vector<double> pushed(BLOCK * wide), moved((BLOCK + 1) * wide);
    double on[BLOCK * N * N], forcing[BLOCK * N], shift[(BLOCK + 1) * N];
    Steps matrix[N * N], inverse[N * N], half, misfit[N];
    for (int i = 0; i < N * N; ++i)
        for (int64_t t = 0; t < BLOCK; ++t) matrix[i][t] = i % (N + 1) == 0;
    for (int64_t lane = 0; lane < lanes; ++lane) {
        const double* own_path = path + lane * N * (steps + 1);
        const double *own_rates = rates + lane * N * steps, *own_by_level = by_level + lane * N * N * steps;
        const double* own_by_theta = by_theta + lane * wide * steps;
        double *own_levels = levels + lane * N * (steps + 1), *own_slopes = slopes + lane * wide * (steps + 1);
        double *own_on = transition + lane * N * N * steps, *own_gain = gain + lane * N * N * steps;
        std::copy(start_slopes + lane * wide, start_slopes + (lane + 1) * wide, moved.begin());
        scatter(moved.data(), wide, steps + 1, 0, 1, own_slopes);
        double largest = 0.0;
        bool broken = false;
        for (int i = 0; i < N; ++i) {
            shift[i] = start[lane * N + i] - own_path[i * (steps + 1)];
            own_levels[i * (steps + 1)] = own_path[i * (steps + 1)] + shift[i];
            largest = std::max(largest, std::fabs(shift[i]));
            broken |= std::isnan(shift[i]);
        }
        for (int64_t k = 0; k < steps; k += BLOCK) {
            const int64_t length = std::min(BLOCK, steps - k);
            for (int64_t t = 0; t < length; ++t) half[t] = 0.5 * span[k + t];
            for (int i = 0; i < N * N; ++i) {
                const double* by = own_by_level + i * steps + k;
                for (int64_t t = 0; t < length; ++t) matrix[i][t] = (i % (N + 1) == 0) - half[t] * by[t];
            }
            invert<N>(matrix, inverse);
            for (int i = 0; i < N; ++i) {
                const double *at = own_path + i * (steps + 1) + k, *rate = own_rates + i * steps + k;
                for (int64_t t = 0; t < length; ++t) misfit[i][t] = 2.0 * half[t] * rate[t] - (at[t + 1] - at[t]);
            }
            for (int i = 0; i < N * N; ++i) {
                double *to = own_on + i * steps + k, *reach = own_gain + i * steps + k;
                for (int64_t t = 0; t < length; ++t) {
                    to[t] = 2.0 * inverse[i][t] - (i % (N + 1) == 0);
                    reach[t] = 2.0 * half[t] * inverse[i][t];
                }
                for (int64_t t = 0; t < length; ++t) on[t * N * N + i] = to[t];
            }
            for (int i = 0; i < N; ++i) {
                for (int64_t t = 0; t < length; ++t) {
                    double total = 0.0;
                    for (int j = 0; j < N; ++j) total += inverse[i * N + j][t] * misfit[j][t];
                    forcing[t * N + i] = total;
                }
                for (int64_t c = 0; c < columns; ++c) {
                    Steps total = {};
                    for (int j = 0; j < N; ++j) {
                        const double* reach = own_gain + (i * N + j) * steps + k;
                        const double* by = own_by_theta + (j * columns + c) * steps + k;
                        for (int64_t t = 0; t < length; ++t) total[t] += reach[t] * by[t];
                    }
                    for (int64_t t = 0; t < length; ++t) pushed[t * wide + i * columns + c] = total[t];
                }
            }
            for (int64_t t = 0; t < length; ++t) {
                step<N>(&on[t * N * N], &shift[t * N], &forcing[t * N], 1, &shift[(t + 1) * N]);
                step<N>(&on[t * N * N], moved.data() + t * wide, pushed.data() + t * wide, columns,
                        moved.data() + (t + 1) * wide);
            }
            for (int i = 0; i < N; ++i)
                for (int64_t t = 0; t < length; ++t) {
                    const double own = shift[(t + 1) * N + i];
                    largest = std::max(largest, std::fabs(own));
                    broken |= std::isnan(own);
                    own_levels[i * (steps + 1) + k + 1 + t] = own_path[i * (steps + 1) + k + 1 + t] + own;
                }
            scatter(moved.data() + wide, wide, steps + 1, k + 1, length, own_slopes);
            std::copy(&shift[length * N], &shift[length * N] + N, shift);
            std::copy(moved.data() + length * wide, moved.data() + (length + 1) * wide, moved.begin());
        }
        defect[lane] = broken ? std::nan("") : largest;
    }
}
}  // namespace

#define EACH(DO) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6)
#define SCAN(N) \
    case N: scan<N>(lanes, steps, columns, a, b, first, x); break;
#define MIDPOINT(N) \
    case N: \
        midpoint<N>(lanes, steps, columns, span, path, rates, by_level, by_theta, start, start_slopes, levels, slopes, \
                    transition, gain, defect); \
        break;

extern "C" void scan_in_time(int64_t n, int64_t lanes, int64_t steps, int64_t columns, const double* a,
                             const double* b, const double* first, double* x) {
    switch (n) { EACH(SCAN) }
}

extern "C" void midpoint_step(int64_t n, int64_t lanes, int64_t steps, int64_t columns, const double* span,
                              const double* path, const double* rates, const double* by_level, const double* by_theta,
                              const double* start, const double* start_slopes, double* levels, double* slopes,
                              double* transition, double* gain, double* defect) {
    switch (n) { EACH(MIDPOINT) }
}
