// Products of small matrices, row by row in memory, for whatever vectors the processor has.
//
// A tile of the result stays in registers while the sum over k runs; the rows of B are read in whole vectors. So B
// and C have rows that are padded to whole vectors (`padded`), and A may have any strides: with the strides of its
// transpose swapped, the same code multiplies by a transpose.
#pragma once

#ifndef REAL
#define REAL float
#endif

namespace her {

using real = REAL;

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64, kAccumulators = 24;  // of 32 registers
#elif defined(__AVX__)
constexpr int kVectorBytes = 32, kAccumulators = 12;  // of 16
#elif defined(__aarch64__)
constexpr int kVectorBytes = 16, kAccumulators = 24;  // of 32
#else
constexpr int kVectorBytes = 16, kAccumulators = 12;  // of 16
#endif
constexpr int kLanes = kVectorBytes / sizeof(real);

typedef real Vector __attribute__((vector_size(kVectorBytes), aligned(alignof(real)), may_alias));

inline int padded(int columns) { return (columns + kLanes - 1) / kLanes * kLanes; }

// What is multiplied, and what is added to each row of the result before the activation.
struct Product {
    const real* a;
    long a_row, a_column;  // strides
    const real* b;
    long b_row;
    real* c;
    long c_row;
    int k;
    const real* bias;  // padded, or null
    bool relu;
};

// M rows and P vectors of columns of the result.
template <int M, int P>
inline __attribute__((always_inline)) void tile(const Product& p, long row, long column) {
    const real* a = p.a + row * p.a_row;
    const real* b = p.b + column;
    Vector sum[M][P];
    for (int j = 0; j < P; ++j) {
        const Vector start = p.bias ? reinterpret_cast<const Vector*>(p.bias + column)[j] : Vector{};
        for (int i = 0; i < M; ++i) sum[i][j] = start;
    }
    for (int k = 0; k < p.k; ++k) {
        Vector right[P];
        for (int j = 0; j < P; ++j) right[j] = reinterpret_cast<const Vector*>(b + k * p.b_row)[j];
        for (int i = 0; i < M; ++i) {
            const real left = a[i * p.a_row + k * p.a_column];
            for (int j = 0; j < P; ++j) sum[i][j] += left * right[j];
        }
    }
    for (int i = 0; i < M; ++i) {
        Vector* out = reinterpret_cast<Vector*>(p.c + (row + i) * p.c_row + column);
        for (int j = 0; j < P; ++j) out[j] = p.relu ? (sum[i][j] < 0 ? Vector{} : sum[i][j]) : sum[i][j];
    }
}

// All rows from `row` on, in tiles of M rows and then of fewer.
template <int M, int P>
void rows_of(const Product& p, int row, int end, long column) {
    for (; row + M <= end; row += M) tile<M, P>(p, row, column);
    if constexpr (M > 1)
        if (row < end) rows_of<(M > 6 ? 6 : M / 2), P>(p, row, end, column);
}

// C [rows, columns] = A B + bias, with as many columns as whole vectors hold.
inline void multiply(const Product& p, int rows, int columns) {
    int column = 0;
    const int end = padded(columns);
    if constexpr (kAccumulators >= 24)
        for (; column + 4 * kLanes <= end; column += 4 * kLanes) rows_of<kAccumulators / 4, 4>(p, 0, rows, column);
    for (; column + 2 * kLanes <= end; column += 2 * kLanes) rows_of<kAccumulators / 2, 2>(p, 0, rows, column);
    for (; column < end; column += kLanes) rows_of<12, 1>(p, 0, rows, column);
}

}  // namespace her
