// A tree with cut joints in Pinocchio, integrated by Boost's Runge-Kutta-Fehlberg 7(8).
//
//   pinocchio_cpp run  MODEL STARTS TOLERANCE REPEATS T...   times the first start
//   pinocchio_cpp many MODEL STARTS TOLERANCE REPEATS T1     every start once per repeat
//   pinocchio_cpp cost MODEL STARTS LOOPS                    one acceleration in a loop
//
// MODEL and STARTS are written by pinocchio_model.py; results are lines "name numbers...".

#include "pinocchio_cpp.hpp"

#include <boost/numeric/odeint/stepper/controlled_runge_kutta.hpp>
#include <boost/numeric/odeint/stepper/runge_kutta_fehlberg78.hpp>

#include <chrono>
#include <cstdio>

namespace odeint = boost::numeric::odeint;

static double now() {
  using clock = std::chrono::steady_clock;
  return std::chrono::duration<double>(clock::now().time_since_epoch()).count();
}

struct Start {
  double t;
  State x;
};

static std::vector<Start> read_starts(const std::string& path, const Problem& problem) {
  Reader in(path);
  std::vector<Start> starts(static_cast<std::size_t>(in.count()));
  for (Start& s : starts) {
    s.t = in.number();
    s.x.resize(static_cast<std::size_t>(problem.model.nq + problem.model.nv));
    for (double& value : s.x) value = in.number();
  }
  return starts;
}

struct Counts {
  long accepted = 0, rejected = 0;
  bool failed = false;
};

// Boost's own step control; steps are cut to end at the wanted times
class Integrator {
 public:
  explicit Integrator(double tolerance)
      : stepper_(Stepper::error_checker_type(tolerance, tolerance)) {}

  Counts advance(Problem& problem, State& x, double& t, double t1) {
    Counts counts;
    auto f = [&problem](const State& y, State& rate, double s) { problem(y, rate, s); };
    while (t < t1) {
      const bool last = t + step_ >= t1;
      double h = last ? t1 - t : step_, before = t;
      if (stepper_.try_step(f, x, t, h) == odeint::success) {
        ++counts.accepted;
        if (last) t = t1;
        step_ = last ? std::max(h, step_) : h;
      } else {
        ++counts.rejected;
        step_ = h;
      }
      if (!std::isfinite(x[0]) || (h < 1e-13 && t == before)) counts.failed = true;
      if (counts.failed || counts.accepted + counts.rejected > 10'000'000) return counts;
    }
    return counts;
  }

 private:
  using Stepper = odeint::controlled_runge_kutta<odeint::runge_kutta_fehlberg78<State>>;
  Stepper stepper_;
  double step_ = 1e-4;
};

static void print_positions(Problem& problem, const State& x) {
  problem.load(x);
  pin::forwardKinematics(problem.model, problem.data, problem.q);
  std::printf("positions");
  for (const Point& body : problem.bodies) {
    const Vector3 r = problem.world(body);
    std::printf(" %.17g %.17g %.17g", r[0], r[1], r[2]);
  }
  std::printf("\n");
}

static void run(Problem& problem, const Start& start, double tolerance, int repeats,
                const std::vector<double>& times) {
  std::vector<State> kept(times.size());
  Counts total;
  for (int k = 0; k < repeats; ++k) {
    const double clock = now();
    problem.evaluations = 0;
    total = {};
    Integrator integrator(tolerance);
    State x = start.x;
    double t = start.t;
    for (std::size_t i = 0; i < times.size(); ++i) {
      const Counts c = integrator.advance(problem, x, t, times[i]);
      total.accepted += c.accepted;
      total.rejected += c.rejected;
      total.failed = c.failed;
      if (c.failed) break;
      kept[i] = x;
    }
    std::printf("seconds %.9g\n", now() - clock);
    if (total.failed) break;
  }
  std::printf("evaluations %ld\naccepted %ld\nrejected %ld\nfailed %d\n", problem.evaluations,
              total.accepted, total.rejected, int(total.failed));
  double gap = 0;
  for (const State& x : kept) {
    if (x.empty()) continue;
    gap = std::max(gap, problem.gap(x));
    print_positions(problem, x);
  }
  std::printf("residual %.9g\n", gap);
}

static void many(Problem& problem, const std::vector<Start>& starts, double tolerance, int repeats,
                 double t1) {
  std::vector<State> ends(starts.size());
  for (int k = 0; k < repeats; ++k) {
    const double clock = now();
    for (std::size_t i = 0; i < starts.size(); ++i) {
      Integrator integrator(tolerance);
      double t = starts[i].t;
      ends[i] = starts[i].x;
      if (integrator.advance(problem, ends[i], t, t1).failed) ends[i][0] = NAN;
    }
    std::printf("seconds %.9g\n", now() - clock);
  }
  for (const State& x : ends) print_positions(problem, x);
}

static void cost(Problem& problem, const Start& start, int loops) {
  State rate(start.x.size());
  volatile double sink = 0;
  for (int repeat = 0; repeat < 5; ++repeat) {
    const double clock = now();
    for (int k = 0; k < loops; ++k) {
      problem(start.x, rate, start.t);
      sink = sink + rate.back();
    }
    std::printf("seconds %.9g\n", (now() - clock) / loops);
  }
  pin::forwardKinematics(problem.model, problem.data, problem.q, problem.v, problem.a);
  std::printf("accelerations");
  for (const Point& body : problem.bodies) {
    const pin::Motion& v = problem.data.v[body.joint];
    const pin::Motion& c = problem.data.a[body.joint];
    const Vector3 speed = v.linear() + v.angular().cross(body.x);
    const Vector3 a = problem.data.oMi[body.joint].rotation() *
                      (c.linear() + c.angular().cross(body.x) + v.angular().cross(speed));
    std::printf(" %.17g %.17g %.17g", a[0], a[1], a[2]);
  }
  std::printf("\n");
}

int main(int count, char** words) try {
  if (count < 5) throw std::runtime_error("too few arguments; see the top of the source");
  const std::string mode = words[1];
  Problem problem(words[2]);
  const std::vector<Start> starts = read_starts(words[3], problem);
  if (mode == "cost") {
    cost(problem, starts.at(0), std::stoi(words[4]));
    return 0;
  }
  if (count < 7) throw std::runtime_error("too few arguments; see the top of the source");
  const double tolerance = std::stod(words[4]);
  const int repeats = std::stoi(words[5]);
  std::vector<double> times;
  for (int k = 6; k < count; ++k) times.push_back(std::stod(words[k]));
  if (mode == "run")
    run(problem, starts.at(0), tolerance, repeats, times);
  else if (mode == "many")
    many(problem, starts, tolerance, repeats, times.back());
  else
    throw std::runtime_error("unknown mode " + mode);
  return 0;
} catch (const std::exception& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}
