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
#if defined(__AVX512F__) && defined(__GNUC__) && !defined(__clang__)
// The builtins behind immintrin.h, whose 46,000 lines would take a third of a second to compile.
#if REAL_BITS == 64
#define BUILT_IN(name, end) __builtin_ia32_##name##pd##end
#else
#define BUILT_IN(name, end) __builtin_ia32_##name##ps##end
#endif
#define COMPARED(a, symbol, code, b) Mask{uint16_t(BUILT_IN(cmp, 512_mask)(a, b, code, -1, 4))}
#define CHOSEN(m, yes, no) BUILT_IN(blendm, _512_mask)(no, yes, m.bits)
#define ROUGH_INVERSE_ROOT(s) BUILT_IN(rsqrt14, 512_mask)(s, s, -1)
#elif defined(__AVX512F__)
#include <immintrin.h>
#if REAL_BITS == 64
#define OF_REALS(name, end) name##_pd##end
#else
#define OF_REALS(name, end) name##_ps##end
#endif
#define COMPARED(a, symbol, code, b) Mask{OF_REALS(_mm512_cmp, _mask)(a, b, code)}
#define CHOSEN(m, yes, no) OF_REALS(_mm512_mask_blend, )(m.bits, no, yes)
#define ROUGH_INVERSE_ROOT(s) OF_REALS(_mm512_rsqrt14, )(s)
#else
#define COMPARED(a, symbol, code, b) ((a)symbol(b))
#endif
#if defined(__AVX512F__)
struct Mask { uint16_t bits; };
INLINE Mask mask(bool x) { return {uint16_t(x ? -1 : 0)}; }
INLINE Mask operator&(Mask a, Mask b) { return {uint16_t(a.bits & b.bits)}; }
INLINE Mask operator|(Mask a, Mask b) { return {uint16_t(a.bits | b.bits)}; }
INLINE Mask operator~(Mask a) { return {uint16_t(~a.bits)}; }
INLINE bool ANY(Mask a) { return a.bits & ((1 << VECTOR) - 1); }
INLINE Vec chosen(Mask m, Vec yes, Vec no) { return CHOSEN(m, yes, no); }
INLINE Vec rough_inverse_root(Vec s) { return ROUGH_INVERSE_ROOT(s); }
#else
typedef BitsVec Mask;
INLINE Mask mask(bool x) { return Mask{} - Bits(x); }
INLINE bool ANY(Mask a) {
    Bits any = 0;
    for (int i = 0; i < VECTOR; ++i) any |= a[i];
    return any;
}
INLINE Vec chosen(Mask m, Vec yes, Vec no) { return m ? yes : no; }
#endif
INLINE Vec greater(Vec a, Vec b) { return a > b ? a : b; }  // b where either is NaN, as in a processor's own instruction
INLINE Vec lesser(Vec a, Vec b) { return a < b ? a : b; }
INLINE bool ANY(bool a) { return a; }
INLINE Mask mask(Mask x) { return x; }
INLINE Vec wide(Vec x) { return x; }
INLINE Vec wide(real x) { return x - Vec{}; }

template <class... X> constexpr bool SHARED = (... && std::is_arithmetic<X>::value);
#define COMPARISON(NAME, symbol, code)                                       \
    template <class A, class B> INLINE auto NAME(A a, B b) {                 \
        if constexpr (SHARED<A, B>) return a symbol b;                       \
        else return COMPARED(wide(a), symbol, code, wide(b));                \
    }
COMPARISON(LESS, <, 17)
COMPARISON(AT_MOST_AS, <=, 18)
COMPARISON(MORE, >, 30)
COMPARISON(AT_LEAST_AS, >=, 29)
COMPARISON(EQUAL, ==, 0)
COMPARISON(DIFFERENT, !=, 4)
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
    else if constexpr (SHARED<C>) return condition ? wide(yes) : wide(no);
    else return chosen(condition, wide(yes), wide(no));
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
