// Gradient steps of DDPG, TD3, SAC, TQC and DQN: forward, backward, clipping, Adam and soft targets, run by run.
//
// The results are those of TorchRL's losses, which the tests compare them with. Everything that Python hands over
// is in `Job`; the structures are mirrored in `job.py`.
#include <cstdint>

#include "network.h"

#if defined(__SSE__)
#include <xmmintrin.h>
#endif

namespace her {

enum Algorithm { kDdpg, kTd3, kSac, kDqn, kTqc };

struct Tensors {
    int rows, columns;
    real *value, *target, *first_moment, *second_moment;  // of all runs; target and moments may be null
    float* steps;  // Adam's counts [counts], or null
};

struct Entry {
    const real* data;  // [runs, rows of a run, width]
    int width;
};

struct Job {
    int algorithm, runs, critics, batch, first_step, steps, rows, actions, threads;
    int actor_layers, critic_layers, actor_tensors, critic_tensors, bfloat16;
    int target_critics;  // number of critics drawn for targets; the actor then follows the mean of all. 0: all
    int dropped;         // how many of the greatest quantiles of all critics TQC's targets leave out
    int counts;          // number of Adam's step counts: one for each run, or one for all
    const Layer *actor, *critic;
    const Tensors* tensors;  // of the actor, of each critic, and SAC's logarithm of the temperature
    int entries;
    const Entry *seen, *next_seen;  // `entries` of each, joined into the networks' input
    const real* action;  // [runs, rows, actions]
    const int64_t* choice;  // [runs, rows], of discrete actions
    const real* reward;     // [runs, rows]
    const uint8_t* terminated;
    const real* weight;    // importance weights, or null
    const real* discount;  // for the next value of each row; null for gamma
    const real* noise;       // [steps, runs, batch, actions], standard normal, for the next action
    const real* own_noise;   // the same for the present action
    const real *low, *high;  // [actions]
    const uint8_t* idle;     // [runs]
    const int32_t* drawn;    // [steps, runs, target_critics], critics
    real gamma, least, greatest, penalty, saturation, max_norm, tau, policy_noise, noise_limit, target_entropy;
    const Adam* adam;  // [runs, steps]
    real* priorities;  // [runs, rows]
    real* losses;      // [3, steps, runs]
};

namespace {

const real kHalfLogTwoPi = real(0.91893853320467274178), kLogTwo = real(0.69314718055994530942);
const real kMostTanh = 1 - (sizeof(real) == 4 ? real(1e-6) : real(1e-15));  // as TorchRL's TanhNormal
const real kFreeArgument = 2, kLargestAction = real(1 - 1e-6);  // as in objectives/actor_terms.py
const real kLeastScale = -10, kGreatestScale = 2;  // of SAC, as in modules/stochastic_actor.py

// Whether the actor draws actions from a distribution, with a temperature.
bool is_stochastic(const Job& job) { return job.algorithm == kSac || job.algorithm == kTqc; }

// Gradient steps of one run.
class Learner {
  public:
    Learner(const Job& job, int run, Arena& arena) : job_(job), run_(run), arena_(arena) {
        int next = 0;
        const int networks = 1 + job.critics;
        for (int n = 0; n < networks; ++n) {
            const bool first = n == 0;
            networks_.emplace_back(first ? job.actor : job.critic, first ? job.actor_layers : job.critic_layers,
                                   job.bfloat16);
            for (int i = 0; i < (first ? job.actor_tensors : job.critic_tensors); ++i)
                networks_.back().parameters.push_back(parameter(job.tensors[next++]));
        }
        for (const Network& network : networks_) {
            targets_.push_back(network);
            targets_.back().uses_targets = true;
        }
        if (is_stochastic(job)) temperature_ = parameter(job.tensors[next]);
    }

    void step(int step) {
        arena_.clear();
        step_ = step;
        first_ = long(run_) * job_.rows + long(step) * job_.batch;
        for (Network& network : networks_) network.begin(arena_);
        for (Network& network : targets_) network.begin(arena_);
        seen_ = joined(job_.seen);
        next_seen_ = joined(job_.next_seen);
        weights_ = arena_.take(job_.batch);
        mean_weights();
        if (job_.algorithm == kDqn)
            learn_q();
        else
            learn_values_and_actions();
        update();
    }

  private:
    const Job& job_;
    const int run_;
    Arena& arena_;
    std::vector<Network> networks_, targets_;  // the actor (or the values of actions), then the critics
    Parameter temperature_{};
    int step_ = 0;
    long first_ = 0;  // first row of the step's batch
    real* weights_ = nullptr;
    Matrix seen_{}, next_seen_{};  // the networks' inputs

    Parameter parameter(const Tensors& tensors) const {
        const long at = long(run_) * tensors.rows * tensors.columns;
        const auto of_run = [at](real* all) { return all ? all + at : nullptr; };
        return {tensors.rows, tensors.columns, of_run(tensors.value), of_run(tensors.target),
                of_run(tensors.first_moment), of_run(tensors.second_moment), {}};
    }

    real& loss(int which) { return job_.losses[(long(which) * job_.steps + step_ - job_.first_step) * job_.runs + run_]; }

    // Scales the importance weights to a mean of 1.
    void mean_weights() {
        double sum = 0;
        for (int b = 0; b < job_.batch; ++b) sum += weights_[b] = job_.weight ? job_.weight[first_ + b] : 1;
        for (int b = 0; b < job_.batch; ++b) weights_[b] *= real(job_.batch / sum);
    }

    // Returns the networks' input: its entries side by side.
    Matrix joined(const Entry* entries) {
        int columns = 0;
        for (int e = 0; e < job_.entries; ++e) columns += entries[e].width;
        const Matrix out = matrix(arena_, job_.batch, columns);
        int column = 0;
        for (int e = 0; e < job_.entries; ++e) {
            const int width = entries[e].width;
            const real* from = entries[e].data + first_ * width;
            for (int b = 0; b < job_.batch; ++b)
                for (int c = 0; c < width; ++c) out[b][column + c] = from[b * width + c];
            column += width;
        }
        return out;
    }

    // Returns the clamped target of a row, from the next state's value.
    real target(int b, real next) const {
        const long row = first_ + b;
        const real discount = job_.discount ? job_.discount[row] : job_.gamma;
        const real value = job_.terminated[row] ? 0 : next;
        return std::min(std::max(job_.reward[row] + discount * value, job_.least), job_.greatest);
    }

    void make_targets(real* values) const {
        for (int b = 0; b < job_.batch; ++b) values[b] = target(b, values[b]);
    }

    // An action drawn from SAC's policy, with the numbers that its gradient needs.
    struct Draw {
        Matrix action, tanh, scale;
        real* log_likelihood;
    };

    const real* noise_of(const real* all) const {
        return all + (long(step_ - job_.first_step) * job_.runs + run_) * job_.batch * job_.actions;
    }

    // The squashed normal distribution of SAC; Haarnoja et al., 2018, appendix C.
    Draw draw(Matrix out, const real* noise) {
        const int actions = job_.actions;
        Draw draw{matrix(arena_, job_.batch, actions), matrix(arena_, job_.batch, actions),
                  matrix(arena_, job_.batch, actions), arena_.take(job_.batch)};
        for (int b = 0; b < job_.batch; ++b) {
            real sum = 0;
            for (int a = 0; a < actions; ++a) {
                const real log_scale = std::min(std::max(out[b][actions + a], kLeastScale), kGreatestScale);
                const real scale = std::exp(log_scale), eps = noise[b * actions + a];
                const real before = out[b][a] + scale * eps, squashed = std::tanh(before);
                const real half = (job_.high[a] - job_.low[a]) / 2, middle = (job_.high[a] + job_.low[a]) / 2;
                const real z = -2 * before, softplus = z > 20 ? z : std::log1p(std::exp(z));
                draw.scale[b][a] = scale;
                draw.tanh[b][a] = std::min(std::max(squashed, -kMostTanh), kMostTanh);
                draw.action[b][a] = middle + half * draw.tanh[b][a];
                sum += -eps * eps / 2 - log_scale - kHalfLogTwoPi - 2 * (kLogTwo - before - softplus) - std::log(half);
            }
            draw.log_likelihood[b] = sum;
        }
        return draw;
    }

    Matrix value_next(int critic, Matrix action) {
        Network& target = targets_[1 + critic];
        Pass pass = target.pass(next_seen_);
        return target.forward(pass, action.data, action.row);
    }

    // Returns the least value of the next action by the target critics: by all, or by the drawn ones.
    real* least_value(Matrix action) {
        const int some = job_.target_critics, count = some ? some : job_.critics;
        const int32_t* drawn = job_.drawn + (long(step_ - job_.first_step) * job_.runs + run_) * some;
        real* least = arena_.take(job_.batch);
        for (int i = 0; i < count; ++i) {
            const Matrix out = value_next(some ? drawn[i] : i, action);
            for (int b = 0; b < job_.batch; ++b) least[b] = i == 0 ? out[b][0] : std::min(least[b], out[b][0]);
        }
        return least;
    }

    // The next action, and the entropy term of its value.
    struct Next {
        Matrix action;
        real* entropy;  // or null
    };

    Next next_action() {
        Network& actor = is_stochastic(job_) ? networks_[0] : targets_[0];
        Pass pass = actor.pass(next_seen_);
        Matrix action = actor.forward(pass);
        if (is_stochastic(job_)) {
            const Draw drawn = draw(action, noise_of(job_.noise));
            const real temperature = std::exp(*temperature_.value);
            for (int b = 0; b < job_.batch; ++b) drawn.log_likelihood[b] *= -temperature;
            return {drawn.action, drawn.log_likelihood};
        }
        if (job_.algorithm == kTd3)
            for (int b = 0; b < job_.batch; ++b)
                for (int a = 0; a < job_.actions; ++a) {
                    const real unclipped = noise_of(job_.noise)[b * job_.actions + a] * job_.policy_noise;
                    const real noise = std::min(std::max(unclipped, -job_.noise_limit), job_.noise_limit);
                    action[b][a] = std::min(std::max(action[b][a] + noise, job_.low[a]), job_.high[a]);
                }
        return {action, nullptr};
    }

    // Computes the gradients of the critics and of the actor.
    void learn_values_and_actions() {
        job_.algorithm == kTqc ? learn_quantiles() : learn_values();
        is_stochastic(job_) ? learn_stochastic_actions() : learn_actions();
    }

    void learn_values() {
        const int batch = job_.batch, actions = job_.actions;
        const Next next = next_action();
        real* wanted = least_value(next.action);
        if (next.entropy)
            for (int b = 0; b < batch; ++b) wanted[b] += next.entropy[b];
        make_targets(wanted);
        const real* action = job_.action + first_ * actions;
        real* priorities = job_.priorities + first_;
        double value_loss = 0;
        for (int n = 1; n <= job_.critics; ++n) {
            Pass pass = networks_[n].pass(seen_, true);
            const Matrix out = networks_[n].forward(pass, action, actions);
            Matrix slope = matrix(arena_, batch, 1);
            for (int b = 0; b < batch; ++b) {
                const real error = out[b][0] - wanted[b], square = error * error;
                const real priority = job_.algorithm == kSac ? std::abs(error) : square;
                priorities[b] = n == 1 ? priority : std::max(priorities[b], priority);
                value_loss += square * weights_[b];
                slope[b][0] = 2 * error * weights_[b] / batch;
            }
            networks_[n].backward(pass, slope);
        }
        loss(1) = real(value_loss / batch);
    }

    // TQC's targets [batch, K] are the quantiles of all critics without the greatest ones; Kuznetsov et al., 2020.
    Matrix quantile_targets() {
        const int batch = job_.batch, quantiles = job_.critic[job_.critic_layers - 1].outputs;
        const int all = job_.critics * quantiles, kept = all - job_.dropped;
        const Next next = next_action();
        Matrix every = matrix(arena_, batch, all);
        for (int n = 0; n < job_.critics; ++n) {
            const Matrix out = value_next(n, next.action);
            for (int b = 0; b < batch; ++b) std::copy_n(out[b], quantiles, every[b] + n * quantiles);
        }
        const auto less = [](real a, real b) { return a < b || (b != b && a == a); };  // NaN is the greatest
        for (int b = 0; b < batch; ++b) {
            if (kept < all) std::nth_element(every[b], every[b] + kept, every[b] + all, less);
            for (int k = 0; k < kept; ++k) every[b][k] = target(b, every[b][k] + next.entropy[b]);
        }
        every.columns = kept;
        return every;
    }

    // Each quantile of each critic learns from all targets, by the quantile Huber loss.
    void learn_quantiles() {
        const int batch = job_.batch, actions = job_.actions;
        const Matrix wanted = quantile_targets();
        const int kept = wanted.columns;
        const real* action = job_.action + first_ * actions;
        real* priorities = job_.priorities + first_;
        double value_loss = 0;
        for (int n = 1; n <= job_.critics; ++n) {
            Pass pass = networks_[n].pass(seen_, true);
            const Matrix out = networks_[n].forward(pass, action, actions);
            const int quantiles = out.columns;
            const real pairs = real(quantiles) * kept;
            Matrix slope = matrix(arena_, batch, quantiles);
            for (int b = 0; b < batch; ++b) {
                const real* goal = wanted[b];
                real distances = 0, costs = 0;
                for (int q = 0; q < quantiles; ++q) {
                    const real quantile = out[b][q], above = (q + real(0.5)) / quantiles, below = 1 - above;
                    real distance = 0, cost = 0, pull = 0;
#pragma omp simd reduction(+ : distance, cost, pull)
                    for (int k = 0; k < kept; ++k) {
                        const real error = goal[k] - quantile, size = std::abs(error), part = error < 0 ? below : above;
                        distance += size;
                        cost += part * (size <= 1 ? error * error / 2 : size - real(0.5));
                        pull += part * (size <= 1 ? error : error < 0 ? real(-1) : real(1));
                    }
                    distances += distance, costs += cost;
                    slope[b][q] = -pull / pairs * weights_[b] / batch;
                }
                priorities[b] = n == 1 ? distances / pairs : std::max(priorities[b], distances / pairs);
                value_loss += costs / pairs * weights_[b];
            }
            networks_[n].backward(pass, slope);
        }
        loss(1) = real(value_loss / batch);
    }

    // A deterministic actor: it follows the first critic, or the mean of all, less the cost of actions.
    void learn_actions() {
        const int batch = job_.batch, actions = job_.actions, followed = job_.target_critics ? job_.critics : 1;
        Network& actor = networks_[0];
        Pass acted = actor.pass(seen_, true);
        const Matrix action = actor.forward(acted);
        Matrix action_slope = matrix(arena_, batch, actions);
        double sum = 0, squares = 0;
        for (int n = 1; n <= followed; ++n) {
            Pass valued = networks_[n].pass(seen_);
            const Matrix value = networks_[n].forward(valued, action.data, action.row);
            Matrix slope = matrix(arena_, batch, 1),
                   critic_slope = n == 1 ? action_slope : matrix(arena_, batch, actions);
            for (int b = 0; b < batch; ++b) {
                slope[b][0] = -weights_[b] / (real(batch) * followed);
                sum += value[b][0] * weights_[b] / followed;
            }
            networks_[n].backward(valued, slope, &critic_slope);
            if (n > 1)
                for (int b = 0; b < batch; ++b)
                    for (int a = 0; a < actions; ++a) action_slope[b][a] += critic_slope[b][a];
        }
        const real price = job_.penalty / (real(batch) * actions);
        const real saturation = job_.saturation / (real(batch) * actions);
        double excesses = 0;
        for (int b = 0; b < batch; ++b)
            for (int a = 0; a < actions; ++a) {
                const real x = action[b][a], size = std::abs(x);
                action_slope[b][a] += 2 * price * x;
                squares += x * x;
                if (saturation == 0) continue;
                const real excess = std::atanh(std::min(size, kLargestAction)) - kFreeArgument;
                if (excess <= 0) continue;
                excesses += excess * excess;
                if (size < kLargestAction)
                    action_slope[b][a] += 2 * saturation * std::copysign(excess, x) / (1 - x * x);
            }
        loss(0) = real(squares * price + excesses * saturation - sum / batch);
        actor.backward(acted, action_slope);
    }

    void learn_stochastic_actions() {
        const int batch = job_.batch, actions = job_.actions;
        Network& actor = networks_[0];
        Pass acted = actor.pass(seen_, true);
        const Matrix out = actor.forward(acted);
        const real* noise = noise_of(job_.own_noise);
        const Draw drawn = draw(out, noise);
        std::vector<Pass> passes;
        std::vector<Matrix> values;
        for (int n = 1; n <= job_.critics; ++n) {
            passes.push_back(networks_[n].pass(seen_));
            values.push_back(networks_[n].forward(passes.back(), drawn.action.data, drawn.action.row));
        }
        Matrix action_slope = matrix(arena_, batch, actions);
        for (int b = 0; b < batch; ++b) std::fill_n(action_slope[b], actions, real(0));
        const real temperature = std::exp(*temperature_.value);
        double actor_loss = 0, temperature_slope = 0;
        const bool follows_mean = job_.target_critics || job_.algorithm == kTqc;  // of all outputs; otherwise the least
        for (int n = 0; n < job_.critics; ++n) {
            const int outputs = values[n].columns;
            const real parts = real(job_.critics) * outputs;
            Matrix slope = matrix(arena_, batch, outputs), critic_slope = matrix(arena_, batch, actions);
            for (int b = 0; b < batch; ++b) {
                if (follows_mean) {
                    std::fill_n(slope[b], outputs, -weights_[b] / batch / parts);
                    for (int q = 0; q < outputs; ++q) actor_loss -= values[n][b][q] / parts * weights_[b];
                    continue;
                }
                int least = 0;
                for (int other = 1; other < job_.critics; ++other)
                    if (values[other][b][0] < values[least][b][0]) least = other;
                slope[b][0] = least == n ? -weights_[b] / batch : 0;
                if (least == n) actor_loss -= values[n][b][0] * weights_[b];
            }
            networks_[n + 1].backward(passes[n], slope, &critic_slope);
            for (int b = 0; b < batch; ++b)
                for (int a = 0; a < actions; ++a) action_slope[b][a] += critic_slope[b][a];
        }
        const real price = job_.penalty / (real(batch) * actions);
        Matrix slope = matrix(arena_, batch, 2 * actions);
        for (int b = 0; b < batch; ++b) {
            actor_loss += temperature * drawn.log_likelihood[b] * weights_[b];
            temperature_slope -= (drawn.log_likelihood[b] + job_.target_entropy) * weights_[b];
            const real surprise = temperature * weights_[b] / batch;
            for (int a = 0; a < actions; ++a) {
                const real squashed = drawn.tanh[b][a], action = drawn.action[b][a];
                const real half = (job_.high[a] - job_.low[a]) / 2, log_scale = out[b][actions + a];
                const real in_action = action_slope[b][a] + 2 * price * action;
                const real before = in_action * half * (1 - squashed * squashed) + surprise * 2 * squashed;
                actor_loss += real(batch) * price * action * action;
                slope[b][a] = before;
                slope[b][actions + a] = before * noise[b * actions + a] * drawn.scale[b][a] - surprise;
                if (log_scale < kLeastScale || log_scale > kGreatestScale) slope[b][actions + a] = 0;
            }
        }
        loss(0) = real(actor_loss / batch);
        loss(2) = real(*temperature_.value * temperature_slope / batch);
        temperature_.gradient = matrix(arena_, 1, 1);
        temperature_.gradient.data[0] = real(temperature_slope / batch);
        actor.backward(acted, slope);
    }

    // Double DQN, van Hasselt et al., 2016: the online network chooses the next action.
    void learn_q() {
        const int batch = job_.batch;
        Network &values = networks_[0], &target = targets_[0];
        Pass next = values.pass(next_seen_), next_target = target.pass(next_seen_);
        const Matrix preferred = values.forward(next), valued = target.forward(next_target);
        real* wanted = arena_.take(batch);
        for (int b = 0; b < batch; ++b)
            wanted[b] = valued[b][std::max_element(preferred[b], preferred[b] + job_.actions) - preferred[b]];
        make_targets(wanted);
        Pass pass = values.pass(seen_, true);
        const Matrix out = values.forward(pass);
        Matrix slope = matrix(arena_, batch, job_.actions);
        double sum = 0;
        for (int b = 0; b < batch; ++b) {
            const long choice = job_.choice[first_ + b];
            const real error = out[b][choice] - wanted[b];
            std::fill_n(slope[b], job_.actions, real(0));
            slope[b][choice] = 2 * error * weights_[b] / batch;
            job_.priorities[first_ + b] = error * error;
            sum += error * error * weights_[b];
        }
        loss(0) = real(sum / batch);
        values.backward(pass, slope);
    }

    // Clips the gradients of the actor, of all critics together and of the temperature; then Adam and targets.
    void update() {
        double critics = 0;
        for (int n = 1; n <= job_.critics; ++n) critics += networks_[n].gradient_square();
        const Adam& adam = job_.adam[long(run_) * job_.steps + step_ - job_.first_step];
        for (int n = 0; n <= job_.critics; ++n) {
            const real clip = clipping(n == 0 ? networks_[0].gradient_square() : critics);
            for (Parameter& parameter : networks_[n].parameters) adam_step(parameter, adam, clip, job_.tau);
        }
        if (is_stochastic(job_)) {
            const double slope = *temperature_.gradient.data;
            adam_step(temperature_, adam, clipping(slope * slope), 0);
        }
    }

    // As torch's clip_grad_norm_.
    real clipping(double square) const {
        const double clip = double(job_.max_norm) / (std::sqrt(square) + 1e-6);
        return real(clip > 1 ? 1 : clip);  // NaN stays what it is
    }
};

}  // namespace
}  // namespace her

extern "C" void her_steps(const her::Job* job) {
    const int tensors = job->actor_tensors + job->critics * job->critic_tensors + her::is_stochastic(*job);
    for (int i = 0; i < tensors; ++i)
        for (int n = 0; job->tensors[i].steps && n < job->counts; ++n)
            if (job->counts == 1 || !job->idle[n]) job->tensors[i].steps[n] += job->steps;
#pragma omp parallel for schedule(dynamic) num_threads(job->threads) if (job->threads > 1)
    for (int run = 0; run < job->runs; ++run) {
        if (job->idle[run]) continue;
#if defined(__SSE__)
        // Adam's moments of units without a gradient become denormal, and denormals are ten times as slow.
        const unsigned before = _mm_getcsr();
        _mm_setcsr(before | 0x8040);
#endif
        static thread_local her::Arena arena;
        her::Learner learner(*job, run, arena);
        for (int step = job->first_step; step < job->first_step + job->steps; ++step) learner.step(step);
#if defined(__SSE__)
        _mm_setcsr(before);
#endif
    }
}

// Lets Python check that its structures have the same size.
extern "C" long her_job_size() { return sizeof(her::Job); }
