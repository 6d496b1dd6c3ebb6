// A control loop around the planner of the cannon: the target moves, and each cycle has a time to plan in.
//
//   host [CYCLES [SECONDS]]

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <limits>

#include "cannon.h"

namespace {

constexpr int MOST_CYCLES = 100000;

// The search reads it before each evaluation. A steady clock: one that is set while a search runs would end it.
double seconds_now(void *) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Owns the memory that a planner lives in. The planner points into it, so that it can be neither copied nor moved.
class Cannon {
 public:
  Cannon() { status_ = cannon_begin(memory_.data(), memory_.size(), &planner_); }
  Cannon(const Cannon &) = delete;
  Cannon &operator=(const Cannon &) = delete;

  int status() const { return status_; }

  int solve(const cannon_state &state, const cannon_options &options, cannon_plan &plan) {
    return cannon_solve(planner_, &state, &options, &plan);
  }

 private:
  alignas(double) std::array<unsigned char, CANNON_MEMORY> memory_;
  cannon_planner *planner_ = nullptr;
  int status_ = CANNON_OK;
};

// What the progress callback has seen of the search under way.
struct Watch {
  long calls = 0;
  int improvements = 0;
  double first = std::numeric_limits<double>::quiet_NaN(), best = first; // NaN: it was never called with a plan
};

// Called before each evaluation with the best plan so far: here a controller may start to move, or end the search.
int look(void *user, const cannon_plan *best) {
  Watch &watch = *static_cast<Watch *>(user);
  ++watch.calls;
  if (!best->found) return 0; // no point with a finite value yet
  if (watch.improvements == 0) watch.first = best->value;
  if (watch.improvements == 0 || best->value > watch.best) ++watch.improvements;
  watch.best = best->value;
  return 0; // anything else ends the search with the best so far
}

const char *name_of(int cannon) { return cannon == CANNON_CANNON_LOWER ? "lower" : "upper"; }

} // namespace

int main(int count, char **words) {
  const int cycles = count > 1 ? std::atoi(words[1]) : 10;
  const double budget = count > 2 ? std::atof(words[2]) : 0.02; // [s]
  if (count > 3 || cycles < 1 || cycles > MOST_CYCLES || !(budget > 0)) {
    std::fprintf(stderr, "usage: %s [CYCLES [SECONDS]]\n", words[0]);
    return 2;
  }

  static Cannon cannon; // static: 20 kB are much for a stack
  if (cannon.status() != CANNON_OK) {
    std::fprintf(stderr, "no planner: %s\n", cannon_message(cannon.status()));
    return 1;
  }

  cannon_point before{};
  bool has_before = false;
  for (int cycle = 0; cycle < cycles; ++cycle) {
    cannon_state state{};
    state.speed = 3.0;
    state.target[0] = 0.5 + 2.0 * cycle / cycles; // [m], it drives away
    state.target[1] = 0.3;
    state.upper_muzzle[1] = 0.8;

    Watch watch;
    cannon_options options{};
    options.seconds = budget;
    options.clock = seconds_now;
    options.progress = look;
    options.user = &watch;
    if (has_before) {
      options.starts = &before;
      options.start_count = 1;
    }

    cannon_plan plan{};
    const int status = cannon.solve(state, options, plan);
    if (status < CANNON_OK) { // there is no plan: keep the one before
      std::printf("target %.2f m: %s\n", state.target[0], cannon_message(status));
      continue;
    }
    std::printf("target %.2f m: %s at %.4f rad, value %.3g, first seen %.3g, ", state.target[0],
                name_of(plan.selections.cannon), plan.actions.theta, plan.value, watch.first);
    std::printf("%d improvements in %ld looks, %.2f ms: %s\n", watch.improvements, watch.calls, 1e3 * plan.seconds,
                cannon_message(status));
    before.actions = plan.actions;
    before.selections = plan.selections;
    has_before = true;
  }
  return 0;
}
