// Kalman filter that whitens the residuals r of an observer with gain L, for several lanes side by side:
//
//     nu_t = r_t - H s_t,    s_{t+1} = F (s_t + K_t nu_t) - F_x L_t r_t
//
// s: expected error of the observer's prediction (N levels), the flow disturbances (N), and the noise of the sensors (C)
// if that is correlated. A missing residual (NaN) corrects nothing and gives a missing innovation. Compile-time sizes: N
// tanks, C sensors, D elements of s.
#include <cmath>
#include <cstdint>

// f (D, D), h (C, D); k (S, D, C); l (S, N, C); r, nu (L, S, C); s (L, D) at the start; path (L, S, D): s after each
// sample.
extern "C" void flow_filter(int64_t lanes, int64_t samples, const double* f, const double* h, const double* k,
                            const double* l, const double* r, const double* s, double* nu, double* path) {
    for (int64_t lane = 0; lane < lanes; ++lane) {
        double state[D], corrected[D];
        for (int i = 0; i < D; ++i) state[i] = s[lane * D + i];
        for (int64_t t = 0; t < samples; ++t) {
            const int64_t at = lane * samples + t;
            for (int i = 0; i < D; ++i) corrected[i] = state[i];
            for (int c = 0; c < C; ++c) {
                double error = r[at * C + c];
                const double residual = error;
                for (int i = 0; i < D; ++i) error -= h[c * D + i] * state[i];
                nu[at * C + c] = error;
                if (std::isnan(error)) continue;
                for (int i = 0; i < D; ++i) corrected[i] += k[(t * D + i) * C + c] * error;
                for (int i = 0; i < N; ++i) corrected[i] -= l[(t * N + i) * C + c] * residual;
            }
            for (int i = 0; i < D; ++i) {
                state[i] = 0.0;
                for (int j = 0; j < D; ++j) state[i] += f[i * D + j] * corrected[j];
                path[at * D + i] = state[i];
            }
        }
    }
}
