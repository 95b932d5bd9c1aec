// Kalman filter and smoother for deviations x of the levels, flow disturbances w and correlated sensor noise v:
//
//     x_{s+1} = A_s x_s + B_s w_s,   y_s = H_s x_s + v_s + e_s,   e ~ N(0, diag R)
//
// w and v are first-order processes: decay factors `keep_s`, white shocks of variance q_s. The state is z = (x, w, v), with
// dimension d and transition F. At each sample marked `fresh` (the start of a recording) it restarts at zero mean with
// covariance diag P0. Compile-time sizes: TANKS (dimension of x and w), CHANNELS (of y), and LAYERS, the number of
// correlated noise terms on each channel, possibly none: v has LAYERS * CHANNELS components. S: samples, W: columns
// that are processed side by side. Matrices are dense and row-major.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <initializer_list>
#include <type_traits>
#include <vector>

namespace {
constexpr int n = TANKS, C = CHANNELS, decaying = n + LAYERS * C, d = n + decaying;

struct Model {
    const double *a, *b, *h;     // (S, n, n), (S, n, n), (S, C, n)
    const double *keep, *q, *r;  // (S, decaying), (S, decaying), (C)
    const double* p0;            // (d)
    const uint8_t *seen, *fresh; // (S, C), (S)
};

// Doubles in a vector register. The compiler keeps wider vectors in memory.
constexpr int REGISTER = REGISTER_BYTES / sizeof(double);

// to += sum over j < B of m_j x_j for R rows and V columns, which stay in registers. `to` and x have rows of W, and the
// element of m for row r and term j lies at m[r * down + j * along].
template <int B, int W, int R, int V>
inline void add_tile(const double* __restrict m, int down, int along, const double* __restrict x,
                     double* __restrict to) {
    constexpr int wide = std::min(V, REGISTER), count = V / wide;
    typedef double Columns __attribute__((vector_size(wide * sizeof(double)), aligned(sizeof(double)), may_alias));
    Columns total[R][count], term[count];
#pragma GCC unroll 16
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int v = 0; v < count; ++v) total[r][v] = *reinterpret_cast<const Columns*>(to + r * W + v * wide);
    for (int j = 0; j < B; ++j) {
#pragma GCC unroll 4
        for (int v = 0; v < count; ++v) term[v] = *reinterpret_cast<const Columns*>(x + j * W + v * wide);
#pragma GCC unroll 16
        for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
            for (int v = 0; v < count; ++v) total[r][v] += m[r * down + j * along] * term[v];
    }
#pragma GCC unroll 16
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
        for (int v = 0; v < count; ++v) *reinterpret_cast<Columns*>(to + r * W + v * wide) = total[r][v];
}

// The same for A rows.
template <int A, int B, int W, int V>
inline void add_columns(const double* m, int down, int along, const double* x, double* to) {
    constexpr int R = 12 * std::min(V, REGISTER) / V;  // twelve registers of sums
    for (int i = 0; i < A / R; ++i) add_tile<B, W, R, V>(m + i * R * down, down, along, x, to + i * R * W);
    add_tile<B, W, A % R, V>(m + A / R * R * down, down, along, x, to + A / R * R * W);
}

// The same for A rows and all W columns.
template <int A, int B, int W>
inline void add_all(const double* __restrict m, int down, int along, const double* __restrict x, double* __restrict to) {
    constexpr int eights = W / 8 * 8, fours = W / 4 * 4;
    for (int k = 0; k < eights; k += 8) add_columns<A, B, W, 8>(m, down, along, x + k, to + k);
    if (fours > eights) add_columns<A, B, W, 4>(m, down, along, x + eights, to + eights);
    for (int i = 0; i < A; ++i)
        for (int j = 0; j < B; ++j)
            for (int k = fours; k < W; ++k) to[i * W + k] += m[i * down + j * along] * x[j * W + k];
}

// to (A, W) += m (A, B) x (B, W)
template <int A, int B, int W>
inline void add_product(const double* m, const double* x, double* to) {
    add_all<A, B, W>(m, B, 1, x, to);
}

// to (B, W) += m (A, B)' x (A, W)
template <int A, int B, int W>
inline void add_product_of_transposed(const double* m, const double* x, double* to) {
    if (W == 1)
        add_all<1, A, B>(x, A, 1, m, to);
    else
        add_all<B, A, W>(m, 1, B, x, to);
}

template <int A, int B>
inline void transpose(const double* __restrict x, double* __restrict to) {
    for (int i = 0; i < A; ++i)
        for (int j = 0; j < B; ++j) to[j * A + i] = x[i * B + j];
}

// to (d, W) = F z, for z (d, W)
template <int W>
inline void forward(const Model& m, int64_t t, const double* __restrict z, double* __restrict to) {
    std::fill(to, to + n * W, 0.0);
    add_product<n, n, W>(m.a + t * n * n, z, to);
    add_product<n, n, W>(m.b + t * n * n, z + n * W, to);
    for (int i = 0; i < decaying; ++i)
        for (int k = 0; k < W; ++k) to[(n + i) * W + k] = m.keep[t * decaying + i] * z[(n + i) * W + k];
}

// to (d, W) = F' z, for z (d, W)
template <int W>
inline void backward(const Model& m, int64_t t, const double* __restrict z, double* __restrict to) {
    std::fill(to, to + n * W, 0.0);
    add_product_of_transposed<n, n, W>(m.a + t * n * n, z, to);
    for (int i = 0; i < decaying; ++i)
        for (int k = 0; k < W; ++k) to[(n + i) * W + k] = m.keep[t * decaying + i] * z[(n + i) * W + k];
    add_product_of_transposed<n, n, W>(m.b + t * n * n, z, to + n * W);
}

// to (C, W) = H z, for z (d, W); H covers x and v, and rows of masked channels are zero. Without __restrict, with which
// g++ 12.2 -O3 returns wrong gains for four levels and two channels with correlated noise.
template <int W>
inline void look(const Model& m, int64_t t, const double* z, double* to) {
    std::fill(to, to + C * W, 0.0);
    for (int i = 0; i < C * n; ++i)  // a reading depends on few levels
        if (const double h = m.h[t * C * n + i]; h != 0.0)
            for (int k = 0; k < W; ++k) to[i / n * W + k] += h * z[i % n * W + k];
    for (int i = 0; i < LAYERS * C; ++i)
        for (int k = 0; k < W; ++k) to[i % C * W + k] += z[(2 * n + i) * W + k];
    for (int c = 0; c < C; ++c)
        if (!m.seen[t * C + c]) std::fill(to + c * W, to + (c + 1) * W, 0.0);
}

// to (d, W) = H' x, for x (C, W), which must be zero for masked channels
template <int W>
inline void look_back(const Model& m, int64_t t, const double* __restrict x, double* __restrict to) {
    std::fill(to, to + 2 * n * W, 0.0);
    for (int i = 0; i < C * n; ++i)
        if (const double h = m.h[t * C * n + i]; h != 0.0)
            for (int k = 0; k < W; ++k) to[i % n * W + k] += h * x[i / n * W + k];
    for (int i = 0; i < LAYERS * C; ++i) std::copy(x + i % C * W, x + (i % C + 1) * W, to + (2 * n + i) * W);
}

// Inverse of the lower Cholesky factor of s (C, C); adds log det s to log_det. False if s is not positive definite.
inline bool inverse_factor(const double* s, double* inverse, double* log_det) {
    double l[C * C] = {};
    for (int i = 0; i < C; ++i)
        for (int j = 0; j <= i; ++j) {
            double total = s[i * C + j];
            for (int k = 0; k < j; ++k) total -= l[i * C + k] * l[j * C + k];
            if (i == j) {
                if (!(total > 0.0)) return false;
                l[i * C + i] = std::sqrt(total);
                *log_det += std::log(total);
            } else {
                l[i * C + j] = total / l[j * C + j];
            }
        }
    std::fill(inverse, inverse + C * C, 0.0);
    for (int j = 0; j < C; ++j) {
        inverse[j * C + j] = 1.0 / l[j * C + j];
        for (int i = j + 1; i < C; ++i) {
            double total = 0.0;
            for (int k = j; k < i; ++k) total -= l[i * C + k] * inverse[k * C + j];
            inverse[i * C + j] = total / l[i * C + i];
        }
    }
    return true;
}

constexpr int64_t BLOCK = 8;  // samples whose numbers of one column share a cache line

// W columns of x (C, columns, S) from `first` on, at the samples from `start` on, side by side: block (length, C, W); and
// back. Columns beyond the last are padding.
template <int W>
inline void gather(const double* x, int64_t samples, int64_t columns, int64_t first, int64_t start, int64_t length,
                   double* block) {
    for (int c = 0; c < C; ++c)
        for (int64_t k = 0; k < std::min<int64_t>(W, columns - first); ++k)
            for (int64_t t = 0; t < length; ++t)
                block[(t * C + c) * W + k] = x[(c * columns + first + k) * samples + start + t];
}

template <int W>
inline void scatter(const double* block, int64_t samples, int64_t columns, int64_t first, int64_t start, int64_t length,
                    double* x) {
    for (int c = 0; c < C; ++c)
        for (int64_t k = 0; k < std::min<int64_t>(W, columns - first); ++k)
            for (int64_t t = 0; t < length; ++t)
                x[(c * columns + first + k) * samples + start + t] = block[(t * C + c) * W + k];
}

// Innovations of unit variance for W columns of y, starting at column `first`.
template <int W>
void whiten(const Model& m, int64_t samples, int64_t columns, int64_t first, const double* gain, const double* white,
            const double* y, double* out) {
    double z[d * W], moved[d * W], nu[C * W];
    std::vector<double> block(BLOCK * C * W);
    for (int64_t t = 0; t < samples; ++t) {
        double* own = &block[t % BLOCK * C * W];
        if (own == block.data()) gather<W>(y, samples, columns, first, t, std::min(BLOCK, samples - t), own);
        if (m.fresh[t]) std::fill(z, z + d * W, 0.0);
        look<W>(m, t, z, nu);
        for (int c = 0; c < C; ++c) {
            const bool on = m.seen[t * C + c];
            for (int k = 0; k < W; ++k) nu[c * W + k] = on ? own[c * W + k] - nu[c * W + k] : 0.0;
        }
        std::fill(own, own + C * W, 0.0);
        add_product<C, C, W>(white + t * C * C, nu, own);
        if (const int64_t done = t % BLOCK + 1; done == BLOCK || t + 1 == samples)
            scatter<W>(block.data(), samples, columns, first, t + 1 - done, done, out);
        if (t + 1 == samples || m.fresh[t + 1]) continue;
        add_product<d, C, W>(gain + t * d * C, nu, z);
        forward<W>(m, t, z, moved);
        std::copy(moved, moved + d * W, z);
    }
}

// Sums over columns: derivatives of the log-likelihood by the logarithm of a factor on q (decaying) and by the variances
// r (C) and p0 (d), less the parts that do not depend on the innovations. `shocks` (S, d), of the first column, see
// kalman_score.
struct Sums {
    double *by_q, *by_r, *by_p0, *shocks;
};

// Adjoint of `whiten`, by recursion backwards in time: out = G' v for W columns of v, if `whiten` is out = G y. Where v are
// innovations, the recursion is that of the disturbance smoother: adds to the sums, if there are any.
template <int W>
void whiten_back(const Model& m, int64_t samples, int64_t columns, int64_t first, const double* gain,
                 const double* white, const double* v, double* out, const Sums* sums) {
    double z[d * W], moved[d * W], nu[C * W];
    std::vector<double> block(BLOCK * C * W, 0.0);
    const auto add_squares = [](const double* x, int count, double* to, const double* weight = nullptr) {
        for (int i = 0; i < count; ++i)
            for (int k = 0; k < W; ++k) to[i] += 0.5 * x[i * W + k] * x[i * W + k] * (weight ? weight[i] : 1.0);
    };
    for (int64_t t = samples - 1; t >= 0; --t) {
        double* own = &block[t % BLOCK * C * W];
        const int64_t start = t - t % BLOCK, length = std::min(BLOCK, samples - start);
        if (t + 1 == start + length) gather<W>(v, samples, columns, first, start, length, block.data());
        if (t + 1 == samples || m.fresh[t + 1]) {
            std::fill(moved, moved + d * W, 0.0);
        } else {
            if (sums) add_squares(z + n * W, decaying, sums->by_q, m.q + t * decaying);
            backward<W>(m, t, z, moved);
        }
        std::fill(nu, nu + C * W, 0.0);
        add_product_of_transposed<C, C, W>(white + t * C * C, own, nu);
        add_product_of_transposed<d, C, W>(gain + t * d * C, moved, nu);
        for (int c = 0; c < C; ++c)
            if (!m.seen[t * C + c]) std::fill(nu + c * W, nu + (c + 1) * W, 0.0);
        if (sums) add_squares(nu, C, sums->by_r);
        std::copy(nu, nu + C * W, own);
        if (out && t == start) scatter<W>(block.data(), samples, columns, first, start, length, out);
        look_back<W>(m, t, nu, z);
        for (int i = 0; i < d * W; ++i) z[i] = moved[i] - z[i];
        if (sums && m.fresh[t]) add_squares(z, d, sums->by_p0);
        for (int i = 0; i < d && sums && first == 0; ++i)
            sums->shocks[t * d + i] = -z[i * W] * (m.fresh[t] ? m.p0[i] : i < n ? 0.0 : m.q[(t - 1) * decaying + i - n]);
    }
}

template <int W>
using Width = std::integral_constant<int, W>;

// walk(Width<W>, first) for tiles of W columns from `first` on. The widest tile is taken of which more than half is filled.
template <class Walk>
void in_tiles(int64_t columns, const Walk& walk) {
    for (int64_t first = 0; first < columns;) {
        const int64_t left = columns - first;
        if (left > 16) walk(Width<32>{}, first), first += 32;
        else if (left > 8) walk(Width<16>{}, first), first += 16;
        else if (left > 4) walk(Width<8>{}, first), first += 8;
        else walk(Width<1>{}, first), first += 1;
    }
}
}  // namespace

extern "C" {
// Riccati recursion. Writes the Kalman gains `gain` (S, d, C) and `white` (S, C, C), the inverse Cholesky factors of
// the innovations' covariances. Returns the log determinant of these, summed over the valid readings, or NaN if one of them
// is not positive definite.
double kalman_gains(int64_t samples, const Model* model, double* gain, double* white) {
    const Model& m = *model;
    std::vector<double> space(3 * d * d + 2 * d * C + 2 * n * n);
    double *p = space.data(), *half = p + d * d, *next = half + d * d, *cross = next + d * d, *shown = cross + d * C;
    double *turned = shown + d * C, s[C * C], weight[C * C], log_det = 0.0;
    for (int64_t t = 0; t < samples; ++t) {
        const uint8_t* on = m.seen + t * C;
        if (m.fresh[t]) {
            std::fill(p, p + d * d, 0.0);
            for (int i = 0; i < d; ++i) p[i * d + i] = m.p0[i];
        }
        look<d>(m, t, p, shown);
        transpose<C, d>(shown, cross);
        look<C>(m, t, cross, s);
        for (int c = 0; c < C; ++c) s[c * C + c] += on[c] ? m.r[c] : 1.0;
        double* own = white + t * C * C;
        if (!inverse_factor(s, own, &log_det)) return std::nan("");
        std::fill(weight, weight + C * C, 0.0);
        add_product_of_transposed<C, C, C>(own, own, weight);
        for (int c = 0; c < C; ++c)
            if (!on[c]) own[c * C + c] = 0.0;
        double* k = gain + t * d * C;
        std::fill(k, k + d * C, 0.0);
        add_product<d, C, C>(cross, weight, k);
        if (t + 1 == samples) break;
        std::fill(next, next + d * d, 0.0);
        add_product<d, C, d>(k, shown, next);
        for (int i = 0; i < d * d; ++i) p[i] -= next[i];
        forward<d>(m, t, p, half);
        // F P F': only the columns of the levels need a product, and P is symmetric.
        for (int j = 0; j < 2 * n; ++j)
            for (int i = 0; i < n; ++i) turned[j * n + i] = half[i * d + j];
        std::fill(next, next + n * n, 0.0);
        add_product<n, n, n>(m.a + t * n * n, turned, next);
        add_product<n, n, n>(m.b + t * n * n, turned + n * n, next);
        for (int i = 0; i < d; ++i)
            for (int j = std::max(i, n); j < d; ++j) p[i * d + j] = half[i * d + j] * m.keep[t * decaying + j - n];
        for (int i = 0; i < n; ++i)
            for (int j = i; j < n; ++j) p[i * d + j] = 0.5 * (next[i * n + j] + next[j * n + i]);
        for (int i = 0; i < d; ++i)
            for (int j = 0; j < i; ++j) p[i * d + j] = p[j * d + i];
        for (int i = 0; i < decaying; ++i) p[(n + i) * (d + 1)] += m.q[t * decaying + i];
    }
    return log_det;
}

// y (C, M, S) -> innovations of unit variance (C, M, S), column by column.
void kalman_innovations(int64_t samples, const Model* model, int64_t columns, const double* gain, const double* white,
                        const double* y, double* out) {
    in_tiles(columns, [=](auto width, int64_t first) {
        whiten<width>(*model, samples, columns, first, gain, white, y, out);
    });
}

// Adjoint of kalman_innovations: v (C, M, S) -> out (C, M, S).
void kalman_transposed(int64_t samples, const Model* model, int64_t columns, const double* gain, const double* white,
                       const double* v, double* out) {
    in_tiles(columns, [=](auto width, int64_t first) {
        whiten_back<width>(*model, samples, columns, first, gain, white, v, out, nullptr);
    });
}

// Disturbance smoother (Durbin and Koopman, 2012, sections 4.5 and 7.3.3). Input: columns nu (C, M, S) of innovations of
// unit variance, the squares of which add up. Output:
//   by_q (decaying): derivatives of the log-likelihood by the logarithm of a factor on the variances q of all samples;
//   by_r (C), by_p0 (d): by the variances R and P0;
//   n_q, n_r, n_p0: minus the parts of these that do not depend on nu; twice n_q, and a variance times twice its n, is
//       the effective number of readings that determine it;
//   shocks (S, d): of the first column, the smoothed state at the start of a recording, else the smoothed shock that
//       leads to the sample.
void kalman_score(int64_t samples, const Model* model, int64_t columns, const double* gain, const double* white,
                  const double* nu, double* by_q, double* by_r, double* by_p0, double* n_q, double* n_r, double* n_p0,
                  double* shocks) {
    const Model& m = *model;
    std::vector<double> space(3 * d * d + 4 * d * C);
    double *big = space.data(), *half = big + d * d, *turned = half + d * d, *inner = turned + d * d;
    double *inner_t = inner + d * C, *wide = inner_t + d * C, *cross = wide + d * C;
    double spread[C * C], by_level[n * n], by_flow[2 * n * n];
    for (double* sum : {by_q, n_q}) std::fill(sum, sum + decaying, 0.0);
    for (double* sum : {by_r, n_r}) std::fill(sum, sum + C, 0.0);
    for (double* sum : {by_p0, n_p0}) std::fill(sum, sum + d, 0.0);
    const Sums sums{by_q, by_r, by_p0, shocks};
    in_tiles(columns, [&](auto width, int64_t first) {
        whiten_back<width>(m, samples, columns, first, gain, white, nu, nullptr, &sums);
    });
    for (int64_t t = samples - 1; t >= 0; --t) {
        const double *k = gain + t * d * C, *w = white + t * C * C;
        if (t + 1 == samples || m.fresh[t + 1]) {
            std::fill(big, big + d * d, 0.0);
        } else {
            for (int i = 0; i < decaying; ++i) n_q[i] += 0.5 * big[(n + i) * (d + 1)] * m.q[t * decaying + i];
            // F' N F: only the rows and columns of the levels and flows need a product, and N is symmetric.
            backward<d>(m, t, big, half);
            for (int i = 0; i < d; ++i)
                for (int j = std::max(i, n); j < d; ++j) big[i * d + j] = half[i * d + j] * m.keep[t * decaying + j - n];
            for (int i = 0; i < 2 * n; ++i) std::copy(half + i * d, half + i * d + n, turned + i * n);
            std::fill(by_level, by_level + n * n, 0.0);
            add_product<n, n, n>(turned, m.a + t * n * n, by_level);
            std::fill(by_flow, by_flow + 2 * n * n, 0.0);
            add_product<2 * n, n, n>(turned, m.b + t * n * n, by_flow);
            for (int i = 0; i < n; ++i)
                for (int j = i; j < n; ++j) big[i * d + j] = by_level[i * n + j];
            for (int i = 0; i < 2 * n; ++i)
                for (int j = std::max(i, n); j < 2 * n; ++j) big[i * d + j] += by_flow[i * n + j - n];
            for (int i = 0; i < d; ++i)
                for (int j = 0; j < i; ++j) big[i * d + j] = big[j * d + i];
        }
        // S^-1 + K' F' N F K
        std::fill(inner, inner + d * C, 0.0);
        add_product<d, d, C>(big, k, inner);
        std::fill(spread, spread + C * C, 0.0);
        add_product_of_transposed<d, C, C>(k, inner, spread);
        add_product_of_transposed<C, C, C>(w, w, spread);
        for (int c = 0; c < C; ++c) n_r[c] += m.seen[t * C + c] ? 0.5 * spread[c * C + c] : 0.0;
        // big = F'NF + Z + Z' with Z = H' (T H / 2 - (F'NF K)') and T = spread, which equals
        // (I - K H)' F'NF (I - K H) + H' S^-1 H.
        for (int c = 0; c < C; ++c)
            for (int e = 0; e < C; ++e)
                if (!m.seen[t * C + c] || !m.seen[t * C + e]) spread[c * C + e] = 0.0;
        look_back<C>(m, t, spread, cross);
        transpose<d, C>(cross, wide);
        transpose<d, C>(inner, inner_t);
        for (int c = 0; c < C; ++c)
            for (int i = 0; i < d; ++i)
                wide[c * d + i] = m.seen[t * C + c] ? 0.5 * wide[c * d + i] - inner_t[c * d + i] : 0.0;
        look_back<d>(m, t, wide, half);
        for (int i = 0; i < d; ++i)
            for (int j = 0; j < d; ++j) big[i * d + j] += half[i * d + j] + half[j * d + i];
        for (int i = 0; i < d && m.fresh[t]; ++i) n_p0[i] += 0.5 * big[i * (d + 1)];
    }
    for (int i = 0; i < decaying; ++i) by_q[i] -= n_q[i];
    for (int c = 0; c < C; ++c) by_r[c] -= n_r[c];
    for (int i = 0; i < d; ++i) by_p0[i] -= n_p0[i];
}

// Levels x (S, n) predicted for each sample from all earlier ones, from residuals y (S, C).
void kalman_predictions(int64_t samples, const Model* model, const double* gain, const double* y, double* levels) {
    const Model& m = *model;
    double z[d], moved[d], nu[C];
    for (int64_t t = 0; t < samples; ++t) {
        if (m.fresh[t]) std::fill(z, z + d, 0.0);
        std::copy(z, z + n, levels + t * n);
        look<1>(m, t, z, nu);
        for (int c = 0; c < C; ++c) nu[c] = m.seen[t * C + c] ? y[t * C + c] - nu[c] : 0.0;
        add_product<d, C, 1>(gain + t * d * C, nu, z);
        forward<1>(m, t, z, moved);
        std::copy(moved, moved + d, z);
    }
}

// Smoothed levels x (S, n) from smoothed shocks (S, d): simulates the state equation.
void kalman_levels(int64_t samples, const Model* model, const double* shocks, double* levels) {
    double z[d] = {}, moved[d] = {};
    for (int64_t t = 0; t < samples; ++t) {
        for (int i = 0; i < d; ++i) z[i] = (model->fresh[t] ? 0.0 : moved[i]) + shocks[t * d + i];
        std::copy(z, z + n, levels + t * n);
        forward<1>(*model, t, z, moved);
    }
}
}
