// Trees of sums for several runs, with the same results as SumTrees in Python, bit for bit.
//
// A level holds `widths[level]` numbers for each run, the leaves first; a node's 16 children follow each other in
// the level below. Memory is prefetched for a whole group of draws, so that draws seldom wait for it.

#include <algorithm>
#include <cstdint>
#include <cstring>

namespace {

constexpr int FAN = 16;
constexpr int GROUP = 32;  // draws or nodes whose memory is fetched ahead

// Returns the next smaller number; 0 stays 0. The number must be at least 0.
inline float below(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    bits -= bits > 0;
    std::memcpy(&x, &bits, sizeof bits);
    return x;
}

inline double below(double x) {
    uint64_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    bits -= bits > 0;
    std::memcpy(&x, &bits, sizeof bits);
    return x;
}

// Returns the sum of a node's children, added in order.
float total(const float* children) {
    double sum = 0.0;
    for (int i = 0; i < FAN; ++i) sum += children[i];
    return static_cast<float>(sum);
}

}  // namespace

extern "C" {

// Finds the leaf of each run at each of its masses, which are from 0 to the sum of its leaves.
// Masses, leaf and value are [runs, draws].
void her_trees_draw(const float* const* levels, const int64_t* widths, int height, int64_t runs, int64_t draws,
                    const double* masses, int64_t* leaf, float* value) {
    const int64_t tops = widths[height - 1];
    for (int64_t run = 0; run < runs; ++run) {
        const float* top = levels[height - 1] + run * tops;
        double sums[64];
        double sum = 0.0;
        for (int64_t i = 0; i < tops; ++i) sums[i] = sum += top[i];
        const double end = below(sum);
        for (int64_t begin = 0; begin < draws; begin += GROUP) {
            const int count = static_cast<int>(std::min<int64_t>(GROUP, draws - begin));
            int64_t node[GROUP];
            double mass[GROUP];
            float node_value[GROUP];
            for (int i = 0; i < count; ++i) {
                mass[i] = masses[run * draws + begin + i];
                const double within = std::min(mass[i], end);
                int64_t child = 0;
                for (int64_t j = 0; j < tops; ++j) child += sums[j] <= within;
                child = std::min(child, tops - 1);
                if (child > 0) mass[i] -= sums[child - 1];
                mass[i] = std::max(mass[i], 0.0);
                node[i] = child;
                node_value[i] = top[child];
            }
            for (int level = height - 2; level >= 0; --level) {
                const float* table = levels[level] + run * widths[level];
                for (int i = 0; i < count; ++i) __builtin_prefetch(table + node[i] * FAN);
                for (int i = 0; i < count; ++i) {
                    const float* children = table + node[i] * FAN;
                    const float within = std::min(static_cast<float>(mass[i]), below(node_value[i]));
                    double running = 0.0;
                    float before = 0.0f;
                    int child = 0;
                    for (int j = 0; j < FAN; ++j) {
                        running += children[j];
                        const float here = static_cast<float>(running);
                        const bool passed = here <= within;
                        before = passed ? here : before;
                        child += passed;
                    }
                    if (child == FAN) {  // only where all children are 0
                        child = FAN - 1;
                        before = 0.0f;
                    }
                    mass[i] = std::max(mass[i] - before, 0.0);
                    node_value[i] = children[child];
                    node[i] = node[i] * FAN + child;
                }
            }
            for (int i = 0; i < count; ++i) {
                leaf[run * draws + begin + i] = node[i];
                value[run * draws + begin + i] = node_value[i];
            }
        }
    }
}

// Sets leaves. `node` [number], their places among the leaves of all runs, is overwritten.
void her_trees_set(float* const* levels, const int64_t* widths, int height, int64_t runs, int64_t number,
                   int64_t* node, const float* value) {
    for (int64_t i = 0; i < number; ++i) {
        if (i + GROUP < number) __builtin_prefetch(levels[0] + node[i + GROUP], 1);
        levels[0][node[i]] = value[i];
    }
    for (int level = 1; level < height; ++level) {
        const float* children = levels[level - 1];
        float* table = levels[level];
        const int64_t all = runs * widths[level];
        if (number >= all) {  // computing all sums is then just as fast
            for (int64_t i = 0; i < all; ++i) table[i] = total(children + i * FAN);
            continue;
        }
        int64_t kept = 0, last = -1;
        for (int64_t i = 0; i < number; ++i) {  // neighbors are often children of the same node
            const int64_t parent = node[i] / FAN;
            if (parent != last) node[kept++] = last = parent;
        }
        number = kept;
        for (int64_t i = 0; i < number; ++i) {
            if (i + GROUP < number) __builtin_prefetch(children + node[i + GROUP] * FAN);
            table[node[i]] = total(children + node[i] * FAN);
        }
    }
}
}
