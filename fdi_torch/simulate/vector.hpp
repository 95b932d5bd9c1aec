// Vectors of as many numbers as a register holds, and their elementary functions.
//
// The expressions of a section use these: a value that all lanes share is a `real`, any other a `Vec`. Every element is
// computed separately and by the same instructions, so that no lane depends on its neighbours.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#define INLINE static inline __attribute__((always_inline))

typedef real Vec __attribute__((vector_size(REGISTER_BYTES)));
typedef real Kept __attribute__((vector_size(REGISTER_BYTES), aligned(sizeof(real)), may_alias));
typedef std::conditional<REAL_BITS == 64, int64_t, int32_t>::type Bits;
enum { VECTOR = REGISTER_BYTES / sizeof(real) };
typedef Bits BitsVec __attribute__((vector_size(REGISTER_BYTES)));

#define EACH_VECTOR for (int l = 0; l < LANES; l += VECTOR)
#define AT(lane) (*reinterpret_cast<Kept *>((lane) + l))

// Mask: a truth value for each element. ANY: whether one is true.
typedef BitsVec Mask;
INLINE Mask mask(bool x) { return Mask{} - Bits(x); }
INLINE Mask mask(Mask x) { return x; }
INLINE bool ANY(bool a) { return a; }
INLINE bool ANY(Mask a) {
    Bits any = 0;
    for (int i = 0; i < VECTOR; ++i) any |= a[i];
    return any;
}
INLINE Vec greater(Vec a, Vec b) { return a > b ? a : b; }  // b where either is NaN, as in a processor's own instruction
INLINE Vec lesser(Vec a, Vec b) { return a < b ? a : b; }
INLINE Vec wide(Vec x) { return x; }
INLINE Vec wide(real x) { return x - Vec{}; }

template <class... X> constexpr bool SHARED = (... && std::is_arithmetic<X>::value);
#define COMPARISON(NAME, symbol)                                             \
    template <class A, class B> INLINE auto NAME(A a, B b) {                 \
        if constexpr (SHARED<A, B>) return a symbol b;                       \
        else return wide(a) symbol wide(b);                                  \
    }
COMPARISON(LESS, <)
COMPARISON(AT_MOST_AS, <=)
COMPARISON(MORE, >)
COMPARISON(AT_LEAST_AS, >=)
COMPARISON(EQUAL, ==)
COMPARISON(DIFFERENT, !=)
template <class A, class B> INLINE auto BOTH(A a, B b) {
    if constexpr (SHARED<A, B>) return a && b;
    else return mask(a) & mask(b);
}
template <class A, class B> INLINE auto EITHER(A a, B b) {
    if constexpr (SHARED<A, B>) return a || b;
    else return mask(a) | mask(b);
}
template <class A> INLINE A NOT(A a) {
    if constexpr (SHARED<A>) return !a;
    else return ~a;
}
template <class C, class A, class B> INLINE auto WHERE(C condition, A yes, B no) {
    if constexpr (SHARED<C, A, B>) return condition ? yes : no;
    else return condition ? wide(yes) : wide(no);
}
template <class A, class B> INLINE auto AT_LEAST(A x, B low) {
    if constexpr (SHARED<A, B>) return x < low ? low : x;
    else return greater(wide(low), wide(x));
}
template <class A, class B> INLINE auto AT_MOST(A x, B high) {
    if constexpr (SHARED<A, B>) return x > high ? high : x;
    else return lesser(wide(high), wide(x));
}
// NaN wins, as in torch.
template <class A, class B> INLINE auto MINIMUM(A a, B b) { return WHERE(DIFFERENT(a, a), a, AT_MOST(b, a)); }
template <class A, class B> INLINE auto MAXIMUM(A a, B b) { return WHERE(DIFFERENT(a, a), a, AT_LEAST(b, a)); }
template <class A> INLINE A SIGN(A a) { return WHERE(MORE(a, real(0)), real(1), WHERE(LESS(a, real(0)), real(-1), a)); }

// A scalar function applied to each element; a compiler uses the library's vector version if there is one.
#define OF_EACH(NAME, function)                                              \
    INLINE Vec NAME(Vec x) {                                                 \
        real y[VECTOR];                                                      \
        std::memcpy(y, &x, sizeof y);                                        \
        for (int i = 0; i < VECTOR; ++i) y[i] = LIBRARY(function)(y[i]);     \
        std::memcpy(&x, y, sizeof y);                                        \
        return x;                                                            \
    }                                                                        \
    INLINE real NAME(real x) { return LIBRARY(function)(x); }
OF_EACH(FABS, fabs)
OF_EACH(SQRT, sqrt)
OF_EACH(EXP, exp)
OF_EACH(LOG, log)
OF_EACH(SIN, sin)
OF_EACH(COS, cos)
OF_EACH(TANH, tanh)
OF_EACH(FLOOR, floor)
OF_EACH(CEIL, ceil)
OF_EACH(TRUNC, trunc)
OF_EACH(ROUND, rint)
INLINE Vec power(Vec x, Vec n) {
    real y[VECTOR], m[VECTOR];
    std::memcpy(y, &x, sizeof y);
    std::memcpy(m, &n, sizeof m);
    for (int i = 0; i < VECTOR; ++i) y[i] = LIBRARY(pow)(y[i], m[i]);
    std::memcpy(&x, y, sizeof y);
    return x;
}
template <class A, class B> INLINE auto POW(A x, B n) {
    if constexpr (SHARED<A, B>) return LIBRARY(pow)(x, n);
    else return power(wide(x), wide(n));
}

// s^(-1/4) for normal s > 0, to two units in the last place: a guess y, then y (1 + h/4 + 5 h^2/32 + 15 h^3/128) with
// h = 1 - s y^4. The processor's approximate roots are accurate to 2^-14; the small term compensates the one in h^4.
INLINE Vec refined(Vec s, Vec y) {
    const Vec square = y * y, h = 1 - (s * square) * square;
    return y + y * h * (real(0.25) + h * (real(5.0 / 32.0 + 1.3e-8) + h * real(15.0 / 128.0)));
}
#if defined(__AVX512F__)
// The builtins behind immintrin.h, whose 46,000 lines would take a third of a second to compile.
#if REAL_BITS == 64
INLINE Vec rough_inverse_root(Vec s) { return __builtin_ia32_rsqrt14pd512_mask(s, s, -1); }
#else
INLINE Vec rough_inverse_root(Vec s) { return __builtin_ia32_rsqrt14ps512_mask(s, s, -1); }
#endif
INLINE Vec INVERSE_FOURTH_ROOT(Vec s) {
    const Vec inverse_root = rough_inverse_root(s);
    return refined(s, inverse_root * rough_inverse_root(inverse_root));
}
#else
INLINE Vec INVERSE_FOURTH_ROOT(Vec s) {  // the guess from the exponent is accurate to 3 % only
    const BitsVec guess = (REAL_BITS == 64 ? Bits(0x4feb028f5c28f800) : Bits(0x4f58147a)) - ((BitsVec)s >> 2);
    return refined(s, refined(s, (Vec)guess));
}
#endif
