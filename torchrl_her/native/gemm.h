// Products of small matrices, row by row in memory, with the widest vectors of the processor.
//
// A tile of the result stays in registers while the sum over k runs; the rows of B are read in whole vectors. So B
// and C have rows that are padded to whole vectors (`padded`). A may have any strides: with its two strides swapped,
// the same code multiplies by the transpose of A.
//
// A and B hold reals, or pairs of bfloat16 numbers that are neighbors along k. A product of two pairs adds two
// products to a sum, which is float32.
#pragma once

#include <cstdint>


#ifndef REAL
#define REAL float
#endif

namespace her {

using real = REAL;

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64, kAccumulators = 24;  // the processor has 32 registers
#elif defined(__AVX__)
constexpr int kVectorBytes = 32, kAccumulators = 12;  // 16 registers
#elif defined(__aarch64__)
constexpr int kVectorBytes = 16, kAccumulators = 24;  // 32 registers
#else
constexpr int kVectorBytes = 16, kAccumulators = 12;  // 16 registers
#endif
constexpr int kLanes = kVectorBytes / sizeof(real);

typedef real Vector __attribute__((vector_size(kVectorBytes), aligned(alignof(real)), may_alias));

inline int padded(int columns) { return (columns + kLanes - 1) / kLanes * kLanes; }

using Pair = uint32_t;  // the first number in the low half
typedef Pair Pairs __attribute__((vector_size(kVectorBytes), aligned(alignof(Pair)), may_alias));

inline Vector add_product(Vector sum, real left, Vector right) { return sum + left * right; }

// Only for float32, whose upper half is a number in bfloat16.
inline Vector add_product(Vector sum, Pair left, Pairs right) {
#if defined(__AVX512BF16__)
    // Not the intrinsic, with which g++ 12 copies the sums to memory and back in each round.
    asm("vdpbf16ps %2, %1, %0" : "+v"(sum) : "v"(Pairs{} + left), "v"(right));
    return sum;
#else
    constexpr Pair kHigh = 0xffff0000;
    const Pairs lefts = Pairs{} + left;
    return sum + (Vector)(lefts << 16) * (Vector)(right << 16) + (Vector)(lefts & kHigh) * (Vector)(right & kHigh);
#endif
}

template <class Number>
struct VectorOf;
template <>
struct VectorOf<real> {
    using Type = Vector;
};
template <>
struct VectorOf<Pair> {
    using Type = Pairs;
};

// One product C = A B, with a bias that is added to each row of C before the activation.
template <class Number>
struct Product {
    const Number* a;
    long a_row, a_column;  // strides
    const Number* b;
    long b_row;
    real* c;
    long c_row;
    int k;  // length of the sum, in reals or in pairs
    const real* bias;  // padded, or null
    bool relu;
};

// Clang unrolls these loops only on request, and then keeps sums in registers, as g++ does without a request.
#if defined(__clang__)
#define UNROLLED _Pragma("clang loop unroll(full)")
#else
#define UNROLLED
#endif

// Computes a tile of the result: M rows, and P vectors of columns.
template <int M, int P, class Number>
inline __attribute__((always_inline)) void tile(const Product<Number>& p, long row, long column) {
    const Number* a = p.a + row * p.a_row;
    const Number* b = p.b + column;
    using Right = typename VectorOf<Number>::Type;
    Vector sum[M][P];
    UNROLLED for (int j = 0; j < P; ++j) {
        const Vector start = p.bias ? reinterpret_cast<const Vector*>(p.bias + column)[j] : Vector{};
        UNROLLED for (int i = 0; i < M; ++i) sum[i][j] = start;
    }
    for (int k = 0; k < p.k; ++k) {
        Right right[P];
        UNROLLED for (int j = 0; j < P; ++j) right[j] = reinterpret_cast<const Right*>(b + k * p.b_row)[j];
        UNROLLED for (int i = 0; i < M; ++i) {
            const Number left = a[i * p.a_row + k * p.a_column];
            UNROLLED for (int j = 0; j < P; ++j) sum[i][j] = add_product(sum[i][j], left, right[j]);
        }
    }
    UNROLLED for (int i = 0; i < M; ++i) {
        Vector* out = reinterpret_cast<Vector*>(p.c + (row + i) * p.c_row + column);
        UNROLLED for (int j = 0; j < P; ++j) out[j] = p.relu ? (sum[i][j] < 0 ? Vector{} : sum[i][j]) : sum[i][j];
    }
}

// Computes the rows from `row` to `end` in tiles of M rows, and the rest in smaller tiles.
template <int M, int P, class Number>
void rows_of(const Product<Number>& p, int row, int end, long column) {
    for (; row + M <= end; row += M) tile<M, P>(p, row, column);
    if constexpr (M > 1)
        if (row < end) rows_of<(M > 6 ? 6 : M / 2), P>(p, row, end, column);
}

// Computes C [rows, columns] = A B + bias, with columns rounded up to whole vectors.
template <class Number>
void multiply(const Product<Number>& p, int rows, int columns) {
    int column = 0;
    const int end = padded(columns);
    if constexpr (kAccumulators >= 24)
        for (; column + 4 * kLanes <= end; column += 4 * kLanes) rows_of<kAccumulators / 4, 4>(p, 0, rows, column);
    for (; column + 2 * kLanes <= end; column += 2 * kLanes) rows_of<kAccumulators / 2, 2>(p, 0, rows, column);
    for (; column < end; column += kLanes) rows_of<12, 1>(p, 0, rows, column);
}

// Returns the bits of a float whose upper half is the nearest number in bfloat16 (ties to even).
inline Pair rounded(float number) {
    Pair bits;
    __builtin_memcpy(&bits, &number, sizeof(bits));
    const bool is_nan = (bits & 0x7fffffff) > 0x7f800000;
    return is_nan ? bits | 0x400000 : bits + 0x7fff + (bits >> 16 & 1);
}

inline Pair pair(real first, real second) { return rounded(float(first)) >> 16 | (rounded(float(second)) & 0xffff0000); }

inline int pairs(int count) { return (count + 1) / 2; }

// Packs neighboring columns into pairs: out [rows, pairs(columns)].
inline void pair_columns(const real* in, long row, int rows, int columns, Pair* out) {
    for (int r = 0; r < rows; ++r, in += row, out += pairs(columns)) {
        for (int c = 0; c < columns / 2; ++c) out[c] = pair(in[2 * c], in[2 * c + 1]);
        if (columns % 2) out[columns / 2] = pair(in[columns - 1], 0);
    }
}

// Packs neighboring rows into pairs: out [pairs(rows), padded(columns)].
inline void pair_rows(const real* in, long row, int rows, int columns, Pair* out) {
    for (int r = 0; r < rows; r += 2, out += padded(columns)) {
        const real *first = in + r * row, *second = first + row;
        if (r + 1 < rows)
            for (int c = 0; c < columns; ++c) out[c] = pair(first[c], second[c]);
        else
            for (int c = 0; c < columns; ++c) out[c] = pair(first[c], 0);
        for (int c = columns; c < padded(columns); ++c) out[c] = 0;
    }
}

}  // namespace her
