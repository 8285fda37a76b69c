// Layers, their gradients, and Adam: one network of one run.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <vector>

#include "gemm.h"

namespace her {

// Scratch memory of a gradient step: taken piece by piece, and released as a whole by `clear`.
class Arena {
  public:
    real* take(long count) {
        count = (count + 63) / 64 * 64;
        while (block_ < blocks_.size() && used_ + count > sizes_[block_]) ++block_, used_ = 0;
        if (block_ == blocks_.size()) {
            sizes_.push_back(std::max(count, 1L << 20));
            blocks_.emplace_back(new real[sizes_.back()]());
        }
        used_ += count;
        return blocks_[block_].get() + used_ - count;
    }
    Pair* take_pairs(long count) {
        static_assert(sizeof(Pair) <= sizeof(real));
        return reinterpret_cast<Pair*>(take(count));
    }
    void clear() { block_ = used_ = 0; }

  private:
    std::vector<std::unique_ptr<real[]>> blocks_;
    std::vector<long> sizes_;
    size_t block_ = 0;
    long used_ = 0;
};

struct Matrix {
    real* data;
    int rows, columns;
    long row;  // stride: padded
    real* operator[](long i) const { return data + i * row; }
};

inline Matrix matrix(Arena& arena, int rows, int columns) {
    return {arena.take(long(rows) * padded(columns)), rows, columns, padded(columns)};
}

enum Activation { kNone, kRelu, kTanh, kElu };
enum Norm { kPlain, kLayerNorm, kBatchNorm };

// A layer, as Python describes it. `joined` of its inputs enter the network here, after the outputs of the layer before.
// A layer with 0 inputs has no product: it normalizes the network's input.
struct Layer {
    int inputs, outputs, joined, activation, norm;
};

constexpr real kNormEpsilon = 1e-5, kMomentum = 0.1;  // as in torch
constexpr int kLeastPaired = 32;     // least width of layers whose products may be in bfloat16

// A parameter [rows, columns] with all that a step changes. Running statistics have no moments, and no gradient.
struct Parameter {
    int rows, columns;
    real *value, *target, *first_moment, *second_moment;
    Matrix gradient;
};

// Results of a forward pass that the backward pass needs.
struct Pass {
    bool learns;                     // whether parameters get gradients; if so, batches are normalized by their own statistics
    std::vector<Matrix> values;      // the input, and each layer's output
    std::vector<Matrix> normalized;  // before scale and shift
    std::vector<real*> spread;       // 1 / standard deviation of each row, or of each column of a batch
};

// Returns the sum of term(0), ..., term(n - 1), lane by lane, so that it is computed in vectors.
template <class Term>
inline real sum_of(int n, Term term) {
    real lanes[kLanes] = {}, sum = 0;
    int c = 0;
    for (; c + kLanes <= n; c += kLanes)
        for (int l = 0; l < kLanes; ++l) lanes[l] += term(c + l);
    for (int l = 0; l < kLanes; ++l) sum += lanes[l];
    for (; c < n; ++c) sum += term(c);
    return sum;
}

class Network {
  public:
    // `bfloat16`: products between hidden layers are of numbers in bfloat16; those of the first and the last layer never are.
    Network(const Layer* layers, int count, bool bfloat16)
        : layers_(layers, layers + count), bfloat16_(bfloat16 && sizeof(real) == sizeof(float)) {}

    // For each layer: weight, bias; if normalized, scale, shift; if by batches, also running mean and variance.
    std::vector<Parameter> parameters;
    bool uses_targets = false;

    // Begins a step: forgets the copies of older weights.
    void begin(Arena& arena) {
        arena_ = &arena;
        weights_.assign(layers_.size(), nullptr);
        transposed_.assign(layers_.size(), nullptr);
        weight_pairs_.assign(layers_.size(), nullptr);
        transposed_pairs_.assign(layers_.size(), nullptr);
        biases_.assign(layers_.size(), nullptr);
    }

    // Prepares a pass for an input [rows, inputs], which several networks may share.
    Pass pass(Matrix input, bool learns = false) {
        const int rows = input.rows;
        Pass pass{learns, {input}, {}, {}};
        for (size_t i = 0; i < layers_.size(); ++i) {
            const int outputs = layers_[i].outputs, norm = layers_[i].norm;
            const int joined = i + 1 < layers_.size() ? layers_[i + 1].joined : 0;
            pass.values.push_back(matrix(*arena_, rows, padded(outputs) + joined));
            pass.values.back().columns = outputs + joined;
            pass.normalized.push_back(norm ? matrix(*arena_, rows, outputs) : Matrix{});
            pass.spread.push_back(norm ? arena_->take(norm == kLayerNorm ? rows : outputs) : nullptr);
        }
        return pass;
    }

    // Computes the network's output. `joined` [rows, width], with a stride, follows the outputs of the layer
    // before, or the network's input; it is null if nothing joins.
    Matrix forward(Pass& pass, const real* joined = nullptr, long joined_row = 0) {
        const int rows = pass.values[0].rows;
        for (size_t i = 0; i < layers_.size(); ++i) {
            const Layer& layer = layers_[i];
            const Matrix in = pass.values[i], out = pass.values[i + 1];
            if (layer.joined && joined)
                for (int r = 0; r < rows; ++r)
                    for (int c = 0; c < layer.joined; ++c)
                        in[r][layer.inputs - layer.joined + c] = joined[r * joined_row + c];
            const bool relu = layer.activation == kRelu && !layer.norm;
            const long width = padded(layer.outputs);
            if (layer.inputs == 0) {  // nothing to multiply
            } else if (paired(i))
                multiply(Product<Pair>{columns_paired(in, layer.inputs), pairs(layer.inputs), 1, weight_pairs(i), width,
                                       out.data, out.row, pairs(layer.inputs), bias(i), relu},
                         rows, layer.outputs);
            else
                multiply(Product<real>{in.data, in.row, 1, weight(i), width, out.data, out.row, layer.inputs, bias(i),
                                       relu},
                         rows, layer.outputs);
            if (layer.norm == kLayerNorm) normalize(i, pass);
            if (layer.norm == kBatchNorm) normalize_batch(i, pass);
            if (!relu) activate(layer, out);
        }
        return pass.values.back();
    }

    // Computes the gradients of all parameters (if the pass learns) from the output's gradient, which is overwritten.
    // `joined_slope` [rows, padded], if not null, gets the gradient of the joined input.
    void backward(const Pass& pass, Matrix slope, Matrix* joined_slope = nullptr) {
        for (int i = int(layers_.size()) - 1; i >= 0; --i) {
            const Layer& layer = layers_[i];
            const int unjoined = layer.inputs - layer.joined;
            activation_slope(layer, pass.values[i + 1], slope);
            if (layer.norm) normalization_slope(i, pass, slope);
            if (layer.inputs == 0) return;
            if (pass.learns) weight_slope(i, pass.values[i], slope);
            if (layer.joined && joined_slope)
                multiply(Product<real>{slope.data, slope.row, 1, transposed(i, unjoined, layer.joined),
                                       padded(layer.joined), joined_slope->data, joined_slope->row, layer.outputs,
                                       nullptr, false},
                         slope.rows, layer.joined);
            const bool done = i == 0 || (layer.joined && !pass.learns);  // no gradient before the joint is needed
            if (done) return;
            Matrix before = matrix(*arena_, slope.rows, unjoined);
            if (paired(i))
                multiply(Product<Pair>{columns_paired(slope, layer.outputs), pairs(layer.outputs), 1,
                                       back_pairs(i, unjoined), padded(unjoined), before.data, before.row,
                                       pairs(layer.outputs), nullptr, false},
                         slope.rows, unjoined);
            else
                multiply(Product<real>{slope.data, slope.row, 1, back(i, unjoined), padded(unjoined),
                                       before.data, before.row, layer.outputs, nullptr, false},
                         slope.rows, unjoined);
            slope = before;
        }
    }

    double gradient_square() const {
        double sum = 0;
        for (const Parameter& p : parameters)
            for (int r = 0; r < p.rows && p.gradient.data; ++r) {
                const real* g = p.gradient[r];
                sum += sum_of(p.columns, [g](int c) { return g[c] * g[c]; });
            }
        return sum;
    }

  private:
    std::vector<Layer> layers_;
    bool bfloat16_;
    Arena* arena_ = nullptr;
    std::vector<real*> weights_, transposed_, biases_;
    std::vector<Pair*> weight_pairs_, transposed_pairs_;

    bool paired(int layer) const {
        const bool hidden = layer > 0 && layers_[layer - 1].inputs > 0 && layer + 1 < int(layers_.size());
        return bfloat16_ && hidden && std::min(layers_[layer].inputs, layers_[layer].outputs) >= kLeastPaired;
    }
    const Pair* columns_paired(Matrix in, int columns) {
        Pair* out = arena_->take_pairs(long(in.rows) * pairs(columns));
        pair_columns(in.data, in.row, in.rows, columns, out);
        return out;
    }
    Pair* rows_paired(const real* in, long row, int rows, int columns) {
        Pair* out = arena_->take_pairs(long(pairs(rows)) * padded(columns));
        pair_rows(in, row, rows, columns, out);
        return out;
    }

    enum { kWeight, kBias, kScale, kShift, kMean, kVariance };

    const Parameter& parameter(int layer, int which) const {
        for (int i = 0; i < layer; ++i) which += 2 * (layers_[i].inputs > 0) + 2 * layers_[i].norm;
        return parameters[layers_[layer].inputs ? which : which - kScale];
    }
    Parameter& parameter(int layer, int which) {
        return const_cast<Parameter&>(static_cast<const Network*>(this)->parameter(layer, which));
    }
    const real* value(const Parameter& p) const { return uses_targets ? p.target : p.value; }

    // Rows that are not whole vectors are copied into padded ones.
    const real* padded_rows(const Parameter& p, std::vector<real*>& kept, int layer) {
        if (p.columns % kLanes == 0) return value(p);
        if (!kept[layer]) {
            kept[layer] = arena_->take(long(p.rows) * padded(p.columns));
            for (int r = 0; r < p.rows; ++r) {
                real* out = kept[layer] + long(r) * padded(p.columns);
                std::copy_n(value(p) + long(r) * p.columns, p.columns, out);
                std::fill(out + p.columns, out + padded(p.columns), real(0));
            }
        }
        return kept[layer];
    }
    const real* weight(int layer) { return padded_rows(parameter(layer, kWeight), weights_, layer); }
    const real* bias(int layer) { return padded_rows(parameter(layer, kBias), biases_, layer); }

    const Pair* weight_pairs(int layer) {
        const Parameter& p = parameter(layer, kWeight);
        if (!weight_pairs_[layer]) weight_pairs_[layer] = rows_paired(value(p), p.columns, p.rows, p.columns);
        return weight_pairs_[layer];
    }

    // Transposes in [rows, columns] to out [columns, padded(rows)].
    template <class Number>
    static void transpose(const Number* in, int rows, int columns, Number* out) {
        const long row = padded(rows);
        constexpr int kBlock = 16;  // a block of both matrices stays in the fastest cache
        for (int r0 = 0; r0 < rows; r0 += kBlock)
            for (int c = 0; c < columns; ++c)
                for (int r = r0; r < std::min(r0 + kBlock, rows); ++r) out[c * row + r] = in[long(r) * columns + c];
    }
    // Returns the transpose [outputs, padded] of some rows of a weight.
    real* transposed(int layer, int first, int count) {
        const Parameter& p = parameter(layer, kWeight);
        real* out = arena_->take(long(p.columns) * padded(count));
        transpose(value(p) + long(first) * p.columns, count, p.columns, out);
        return out;
    }
    const real* back(int layer, int unjoined) {
        if (!transposed_[layer]) transposed_[layer] = transposed(layer, 0, unjoined);
        return transposed_[layer];
    }
    const Pair* back_pairs(int layer, int unjoined) {
        if (!transposed_pairs_[layer]) {
            const Parameter& p = parameter(layer, kWeight);
            const Pair* rows = columns_paired({const_cast<real*>(value(p)), unjoined, p.columns, p.columns}, p.columns);
            transposed_pairs_[layer] = arena_->take_pairs(long(pairs(p.columns)) * padded(unjoined));
            transpose(rows, unjoined, pairs(p.columns), transposed_pairs_[layer]);
        }
        return transposed_pairs_[layer];
    }

    void normalize(int layer, Pass& pass) {
        const int n = layers_[layer].outputs;
        const Matrix out = pass.values[layer + 1], kept = pass.normalized[layer];
        const real *scale = value(parameter(layer, kScale)), *shift = value(parameter(layer, kShift));
        for (int r = 0; r < out.rows; ++r) {
            real *y = out[r], *x = kept[r];
            const real mean = sum_of(n, [y](int c) { return y[c]; }) / n;
            const real variance = sum_of(n, [y, mean](int c) { return (y[c] - mean) * (y[c] - mean); }) / n;
            const real spread = 1 / std::sqrt(variance + kNormEpsilon);
            pass.spread[layer][r] = spread;
            for (int c = 0; c < n; ++c) {
                x[c] = (y[c] - mean) * spread;
                y[c] = x[c] * scale[c] + shift[c];
            }
        }
    }

    // Normalizes by the batch's statistics if the pass learns, and moves the running ones; otherwise by the running ones.
    void normalize_batch(int layer, Pass& pass) {
        const int n = layers_[layer].outputs;
        const Matrix out = pass.values[layer + 1], in = layers_[layer].inputs ? out : pass.values[layer];
        const int rows = out.rows;
        const real *mean = value(parameter(layer, kMean)), *variance = value(parameter(layer, kVariance));
        if (pass.learns) {
            const Matrix statistics = matrix(*arena_, 2, n);
            real *__restrict sum = statistics[0], *__restrict squares = statistics[1];
            std::fill_n(sum, 2 * statistics.row, real(0));
            for (int r = 0; r < rows; ++r)
                for (int c = 0; c < n; ++c) sum[c] += in[r][c];
            for (int c = 0; c < n; ++c) sum[c] /= rows;
            for (int r = 0; r < rows; ++r)
                for (int c = 0; c < n; ++c) squares[c] += (in[r][c] - sum[c]) * (in[r][c] - sum[c]);
            real *running_mean = parameter(layer, kMean).value, *running_variance = parameter(layer, kVariance).value;
            for (int c = 0; c < n; ++c) {
                running_mean[c] += kMomentum * (sum[c] - running_mean[c]);
                running_variance[c] += kMomentum * (squares[c] / (rows - 1) - running_variance[c]);
                squares[c] /= rows;
            }
            mean = sum, variance = squares;
        }
        real* __restrict spread = pass.spread[layer];
        for (int c = 0; c < n; ++c) spread[c] = 1 / std::sqrt(variance[c] + kNormEpsilon);
        const real *scale = value(parameter(layer, kScale)), *shift = value(parameter(layer, kShift));
        for (int r = 0; r < rows; ++r) {
            real *__restrict x = pass.normalized[layer][r], *y = out[r];
            for (int c = 0; c < n; ++c) x[c] = (in[r][c] - mean[c]) * spread[c];
            for (int c = 0; c < n; ++c) y[c] = x[c] * scale[c] + shift[c];
        }
    }

    void normalization_slope(int layer, const Pass& pass, Matrix slope) {
        const int n = layers_[layer].outputs;
        const bool of_batch = layers_[layer].norm == kBatchNorm;
        Parameter &scale = parameter(layer, kScale), &shift = parameter(layer, kShift);
        if (pass.learns)
            for (Parameter* p : {&scale, &shift}) {
                p->gradient = matrix(*arena_, 1, n);
                std::fill_n(p->gradient.data, n, real(0));
            }
        real *__restrict in_scale = scale.gradient.data, *__restrict in_shift = shift.gradient.data;
        const real *factor = value(scale), *spreads = pass.spread[layer];
        for (int r = 0; r < slope.rows; ++r) {
            real* s = slope[r];
            const real* x = pass.normalized[layer][r];
            if (pass.learns) {
                for (int c = 0; c < n; ++c) in_scale[c] += s[c] * x[c];
                for (int c = 0; c < n; ++c) in_shift[c] += s[c];
            }
            if (of_batch) continue;
            const real spread = spreads[r];
            for (int c = 0; c < n; ++c) s[c] *= factor[c];
            const real mean = sum_of(n, [s](int c) { return s[c]; }) / n;
            const real along = sum_of(n, [s, x](int c) { return s[c] * x[c]; }) / n;
            for (int c = 0; c < n; ++c) s[c] = spread * (s[c] - mean - x[c] * along);
        }
        for (int r = 0; r < slope.rows && of_batch; ++r) {
            real* s = slope[r];
            const real *x = pass.normalized[layer][r], rows = real(slope.rows);
            if (pass.learns)
                for (int c = 0; c < n; ++c) s[c] -= (in_shift[c] + x[c] * in_scale[c]) / rows;
            for (int c = 0; c < n; ++c) s[c] *= factor[c] * spreads[c];
        }
    }

    static void activate(const Layer& layer, Matrix out) {
        for (int r = 0; r < out.rows; ++r) {
            real* y = out[r];
            if (layer.activation == kRelu)
                for (int c = 0; c < layer.outputs; ++c) y[c] = y[c] < 0 ? 0 : y[c];
            else if (layer.activation == kTanh)
                for (int c = 0; c < layer.outputs; ++c) y[c] = std::tanh(y[c]);
            else if (layer.activation == kElu)
                for (int c = 0; c < layer.outputs; ++c) y[c] = y[c] > 0 ? y[c] : std::expm1(y[c]);
        }
    }

    // Multiplies a gradient by the slope of the activation, which its output determines.
    static void activation_slope(const Layer& layer, Matrix out, Matrix slope) {
        for (int r = 0; r < out.rows; ++r) {
            const real* y = out[r];
            real* s = slope[r];
            if (layer.activation == kRelu)
                for (int c = 0; c < layer.outputs; ++c) s[c] = y[c] <= 0 ? 0 : s[c];
            else if (layer.activation == kTanh)
                for (int c = 0; c < layer.outputs; ++c) s[c] *= 1 - y[c] * y[c];
            else if (layer.activation == kElu)
                for (int c = 0; c < layer.outputs; ++c) s[c] *= y[c] > 0 ? 1 : y[c] + 1;
        }
    }

    void weight_slope(int layer, Matrix in, Matrix slope) {
        const Layer& shape = layers_[layer];
        Parameter &weight = parameter(layer, kWeight), &bias = parameter(layer, kBias);
        weight.gradient = matrix(*arena_, shape.inputs, shape.outputs);
        bias.gradient = matrix(*arena_, 1, shape.outputs);
        Matrix& out = weight.gradient;
        if (paired(layer))
            multiply(Product<Pair>{rows_paired(in.data, in.row, slope.rows, shape.inputs), 1, padded(shape.inputs),
                                   rows_paired(slope.data, slope.row, slope.rows, shape.outputs), padded(shape.outputs),
                                   out.data, out.row, pairs(slope.rows), nullptr, false},
                     shape.inputs, shape.outputs);
        else
            multiply(Product<real>{in.data, 1, in.row, slope.data, slope.row, out.data, out.row, slope.rows, nullptr,
                                   false},
                     shape.inputs, shape.outputs);
        real* sum = bias.gradient.data;
        std::fill_n(sum, shape.outputs, real(0));
        for (int r = 0; r < slope.rows; ++r)
            for (int c = 0; c < shape.outputs; ++c) sum[c] += slope[r][c];
    }
};

// The numbers of Adam for one step: the step's size and the divisor of the second moment's root, bias-corrected; the
// second beta; 1 minus each beta, which would lose digits if it were computed here; epsilon.
struct Adam {
    real size, spread, beta2, rest1, rest2, epsilon;
};

// Makes one step of Adam in place, with clipped gradients, if there are moments; then the soft update of the target.
inline void adam_step(Parameter& p, const Adam& adam, real clip, real tau) {
    for (int r = 0; r < p.rows; ++r) {
        const long begin = long(r) * p.columns;
        const real* __restrict gradient = p.gradient[r];
        real *__restrict m = p.first_moment + begin, *__restrict v = p.second_moment + begin;
        real *__restrict w = p.value + begin, *__restrict t = p.target ? p.target + begin : nullptr;
        for (int c = 0; c < p.columns && m; ++c) {
            const real g = gradient[c] * clip;
            m[c] += (g - m[c]) * adam.rest1;
            v[c] = v[c] * adam.beta2 + g * g * adam.rest2;
            w[c] -= adam.size * m[c] / (std::sqrt(v[c]) / adam.spread + adam.epsilon);
        }
        if (t && tau > 0)
            for (int c = 0; c < p.columns; ++c) t[c] += tau * (w[c] - t[c]);
    }
}

}  // namespace her
