// Kalman filter that whitens the residuals r of an observer with gain L, for several lanes side by side:
//
//     nu_t = r_t - H s_t,    s_{t+1} = F (s_t + K_t nu_t) - F_x L_t r_t
//
// s: expected error of the observer's prediction (N levels), the flow disturbances (N), and the noise of the sensors (C)
// if that is correlated. A missing residual (NaN) corrects nothing and gives a missing innovation. Compile-time sizes: N
// tanks, C sensors, D elements of s.
//
// The covariance P of s decides about the gain K. As long as no residual is missing, P and K are those of tables. From a
// missing one until P is steady again, P is part of the filter's state, and with the rows p of the present residuals
//
//     S = H_p P H_p' + R_p,    K = P H_p' S^-1,    P <- F ((I - K H_p) P (I - K H_p)' + K R_p K') F' + Q.
//
// The innovations are then brought to the covariance that they have in the steady state, by the Cholesky factors of both.
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

constexpr int PACKED = D * (D + 1) / 2;  // elements of a lower triangle
constexpr double CLOSE = 1e-6;           // share of its steady value within which a covariance is steady
constexpr double NEGLIGIBLE = 1e-12;     // variance beside the largest one

// f (D, D), h (C, D); q (D), w (C): variances of the shocks and of the white noise; steady (D, D), opening
// (openings, D, D): P by the tables.
struct Model {
    const double *f, *h, *q, *w, *steady, *opening;
    int64_t openings;
};

// What replaces the tables at the samples where `own` is set: gain (S, D, C), scale (S, C, C) of the innovations; and P
// after each sample, packed (S, PACKED), 0 where it is that of the tables.
struct Course {
    std::vector<char> own;
    std::vector<double> gain, scale, covariance;
};

// Lower Cholesky factor of a (n, n) in place, rows of C elements.
void factorize(double* a, int n) {
    for (int j = 0; j < n; ++j)
        for (int i = j; i < n; ++i) {
            double sum = a[i * C + j];
            for (int k = 0; k < j; ++k) sum -= a[i * C + k] * a[j * C + k];
            a[i * C + j] = i == j ? std::sqrt(sum) : sum / a[j * C + j];
        }
}

// H_p P (n, D) and the covariance of the innovations of n present sensors, rows of C elements.
void predict(const Model& m, const double* p, const int* present, int n, double* hp, double* s) {
    for (int a = 0; a < n; ++a)
        for (int i = 0; i < D; ++i) {
            double sum = 0.0;
            for (int j = 0; j < D; ++j) sum += m.h[present[a] * D + j] * p[j * D + i];
            hp[a * D + i] = sum;
        }
    for (int a = 0; a < n; ++a)
        for (int b = 0; b < n; ++b) {
            double sum = a == b ? m.w[present[a]] : 0.0;
            for (int j = 0; j < D; ++j) sum += hp[a * D + j] * m.h[present[b] * D + j];
            s[a * C + b] = sum;
        }
}

// Gain and scale of one sample by the present sensors, and P at the next one.
void correct(const Model& m, double* p, const int* present, int n, double* gain, double* scale) {
    double hp[C * D], root[C * C], usual[C * C], keep[D * D], moved[D * D];
    predict(m, m.steady, present, n, hp, usual);
    factorize(usual, n);
    predict(m, p, present, n, hp, root);
    factorize(root, n);
    for (int i = 0; i < D * C; ++i) gain[i] = 0.0;
    for (int i = 0; i < C * C; ++i) scale[i] = 0.0;
    for (int i = 0; i < D; ++i) {  // K' = root^-T root^-1 H_p P
        double x[C];
        for (int a = 0; a < n; ++a) {
            x[a] = hp[a * D + i];
            for (int b = 0; b < a; ++b) x[a] -= root[a * C + b] * x[b];
            x[a] /= root[a * C + a];
        }
        for (int a = n - 1; a >= 0; --a) {
            for (int b = a + 1; b < n; ++b) x[a] -= root[b * C + a] * x[b];
            x[a] /= root[a * C + a];
            gain[i * C + present[a]] = x[a];
        }
    }
    for (int a = 0; a < n; ++a) {  // a row of usual root^-1
        double x[C];
        for (int b = a; b >= 0; --b) {
            x[b] = usual[a * C + b];
            for (int k = b + 1; k <= a; ++k) x[b] -= x[k] * root[k * C + b];
            x[b] /= root[b * C + b];
            scale[present[a] * C + present[b]] = x[b];
        }
    }
    for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j) {
            double sum = i == j ? 1.0 : 0.0;
            for (int c = 0; c < C; ++c) sum -= gain[i * C + c] * m.h[c * D + j];
            keep[i * D + j] = sum;
        }
    const auto transformed = [&](const double* by) {
        for (int i = 0; i < D; ++i)
            for (int j = 0; j < D; ++j) {
                double sum = 0.0;
                for (int k = 0; k < D; ++k) sum += by[i * D + k] * p[k * D + j];
                moved[i * D + j] = sum;
            }
        for (int i = 0; i < D; ++i)
            for (int j = 0; j <= i; ++j) {
                double sum = 0.0;
                for (int k = 0; k < D; ++k) sum += moved[i * D + k] * by[j * D + k];
                p[i * D + j] = p[j * D + i] = sum;
            }
    };
    transformed(keep);
    for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j)
            for (int c = 0; c < C; ++c) p[i * D + j] += gain[i * C + c] * m.w[c] * gain[j * C + c];
    transformed(m.f);
    for (int i = 0; i < D; ++i) p[i * D + i] += m.q[i];
}

bool is_steady(const Model& m, const double* p) {
    double largest = 0.0;
    for (int i = 0; i < D; ++i) largest = std::fmax(largest, m.steady[i * D + i]);
    for (int i = 0; i < D; ++i)
        for (int j = 0; j <= i; ++j) {
            const double unit = std::sqrt(m.steady[i * D + i] * m.steady[j * D + j]) * CLOSE + NEGLIGIBLE * largest;
            if (!(std::fabs(p[i * D + j] - m.steady[i * D + j]) <= unit)) return false;
        }
    return true;
}

// The course of P along residuals r (S, C), from that of `start` (PACKED), 0 for that of the tables.
void follow(const Model& m, int64_t samples, const double* r, const double* start, Course& course) {
    double p[D * D];
    bool own = false;
    for (int i = 0; i < D; ++i)
        for (int j = 0; j <= i; ++j) {
            p[i * D + j] = p[j * D + i] = start[i * (i + 1) / 2 + j];
            own = own || p[i * D + j] != 0.0;
        }
    course.own.assign(samples, 0);
    course.covariance.assign(samples * PACKED, 0.0);
    for (int64_t t = 0; t < samples; ++t) {
        int present[C], n = 0;
        for (int c = 0; c < C; ++c)
            if (!std::isnan(r[t * C + c])) present[n++] = c;
        if (!own && n == C) continue;
        if (!own) {
            const double* by_table = t < m.openings ? m.opening + t * D * D : m.steady;
            for (int i = 0; i < D * D; ++i) p[i] = by_table[i];
        }
        course.own[t] = 1;
        course.gain.resize(samples * D * C);
        course.scale.resize(samples * C * C);
        correct(m, p, present, n, &course.gain[t * D * C], &course.scale[t * C * C]);
        own = n < C || t + 1 < m.openings || !is_steady(m, p);
        if (!own) continue;
        for (int i = 0; i < D; ++i)
            for (int j = 0; j <= i; ++j) course.covariance[t * PACKED + i * (i + 1) / 2 + j] = p[i * D + j];
    }
}

bool follows_alike(int64_t samples, const double* r, const double* other, const double* start, const double* others) {
    for (int i = 0; i < PACKED; ++i)
        if (start[i] != others[i]) return false;
    for (int64_t i = 0; i < samples * C; ++i)
        if (std::isnan(r[i]) != std::isnan(other[i])) return false;
    return true;
}

}  // namespace

// k (S, D, C), spread (S, C): gain and standard deviation of the innovations by the tables; l (S, N, C); r, nu
// (L, S, C); s (L, D + PACKED): state and P at the start; path (L, S, D + PACKED): after each sample, or null.
extern "C" void flow_filter(int64_t lanes, int64_t samples, int64_t openings, const double* f, const double* h,
                            const double* q, const double* w, const double* steady, const double* opening,
                            const double* k, const double* spread, const double* l, const double* r, const double* s,
                            double* nu, double* path) {
    const Model model{f, h, q, w, steady, opening, openings};
    Course course;
    constexpr int SIZE = D + PACKED;
    for (int64_t lane = 0; lane < lanes; ++lane) {
        const double *own_r = r + lane * samples * C, *start = s + lane * SIZE + D;
        if (!lane || !follows_alike(samples, own_r, own_r - samples * C, start, start - SIZE))
            follow(model, samples, own_r, start, course);
        double state[D], corrected[D];
        for (int i = 0; i < D; ++i) state[i] = s[lane * SIZE + i];
        for (int64_t t = 0; t < samples; ++t) {
            const int64_t at = lane * samples + t;
            const double* gain = course.own[t] ? &course.gain[t * D * C] : k + t * D * C;
            for (int i = 0; i < D; ++i) corrected[i] = state[i];
            double errors[C];
            for (int c = 0; c < C; ++c) {
                double error = r[at * C + c];
                const double residual = error;
                for (int i = 0; i < D; ++i) error -= h[c * D + i] * state[i];
                errors[c] = error;
                if (std::isnan(error)) continue;
                for (int i = 0; i < D; ++i) corrected[i] += gain[i * C + c] * error;
                for (int i = 0; i < N; ++i) corrected[i] -= l[(t * N + i) * C + c] * residual;
            }
            for (int c = 0; c < C; ++c) {
                if (!course.own[t] || std::isnan(errors[c])) {
                    nu[at * C + c] = errors[c] / spread[t * C + c];
                    continue;
                }
                nu[at * C + c] = 0.0;
                for (int b = 0; b <= c; ++b)
                    if (!std::isnan(r[at * C + b])) nu[at * C + c] += course.scale[(t * C + c) * C + b] * errors[b];
            }
            for (int i = 0; i < D; ++i) {
                state[i] = 0.0;
                for (int j = 0; j < D; ++j) state[i] += f[i * D + j] * corrected[j];
            }
            if (!path) continue;
            double* after = path + at * SIZE;
            for (int i = 0; i < D; ++i) after[i] = state[i];
            for (int i = 0; i < PACKED; ++i) after[D + i] = course.covariance[t * PACKED + i];
        }
    }
}
