// The Kalman filter of law_errors.py: innovations of unit variance beside M errors of which C residuals are linear
// functions. Sizes are those of small matrices, so that each sum is a plain loop with the same order in every call.
#include <cmath>
#include <cstdint>
#include <vector>

// effects (S, C, M), white (S, C): 0 where a reading is missing; keep, shock (S, M): share of each error that is left
// after an interval, and the variance that is added. mean (M), covariance (M, M): before the first sample, then after
// the last. rest (S, C): innovations.
extern "C" void law_errors(int64_t samples, int64_t C, int64_t M, const double *effects, const double *white,
                           const double *keep, const double *shock, double *mean, double *covariance, double *rest) {
    std::vector<double> spread(C * M), root(C * C);
    for (int64_t k = 0; k < samples; ++k, effects += C * M, white += C, keep += M, shock += M, rest += C) {
        for (int64_t i = 0; i < M; ++i) {
            mean[i] *= keep[i];
            for (int64_t j = 0; j < M; ++j) covariance[i * M + j] *= keep[i] * keep[j];
            covariance[i * M + i] += shock[i];
        }
        for (int64_t c = 0; c < C; ++c) {
            rest[c] = white[c];
            for (int64_t j = 0; j < M; ++j) {
                double sum = 0.0;
                for (int64_t i = 0; i < M; ++i) sum += effects[c * M + i] * covariance[i * M + j];
                spread[c * M + j] = sum;
                rest[c] -= effects[c * M + j] * mean[j];
            }
        }
        for (int64_t c = 0; c < C; ++c) {  // Cholesky factor of I + D P D', and division by it
            for (int64_t b = 0; b <= c; ++b) {
                double sum = c == b;
                for (int64_t j = 0; j < M; ++j) sum += spread[c * M + j] * effects[b * M + j];
                root[c * C + b] = sum;
            }
        }
        for (int64_t c = 0; c < C; ++c) {
            for (int64_t b = 0; b < c; ++b) {
                double &low = root[c * C + b];
                for (int64_t a = 0; a < b; ++a) low -= root[c * C + a] * root[b * C + a];
                low /= root[b * C + b];
                root[c * C + c] -= low * low;
                rest[c] -= low * rest[b];
                for (int64_t j = 0; j < M; ++j) spread[c * M + j] -= low * spread[b * M + j];
            }
            const double scale = root[c * C + c] = std::sqrt(root[c * C + c]);
            rest[c] /= scale;
            for (int64_t j = 0; j < M; ++j) spread[c * M + j] /= scale;
        }
        for (int64_t c = 0; c < C; ++c) {
            for (int64_t i = 0; i < M; ++i) {
                mean[i] += rest[c] * spread[c * M + i];
                for (int64_t j = 0; j < M; ++j) covariance[i * M + j] -= spread[c * M + i] * spread[c * M + j];
            }
        }
    }
}
