// A tree with cut joints in Pinocchio: its model file, its loads, its accelerations.

#pragma once

#include <pinocchio/algorithm/cholesky.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace pin = pinocchio;
using Vector3 = Eigen::Vector3d;
using Matrix3 = Eigen::Matrix3d;
using State = std::vector<double>;

struct Signal {
  double rate, phase;
  double operator()(double t) const { return std::sin(rate * t + phase); }
};
struct Point {
  std::size_t joint;
  Vector3 x;
};
struct Wrench {
  std::size_t joint;
  pin::Force value;
};
struct Actuator {
  std::size_t base, slider;
  pin::Force unit;  // on the slider, per newton, in the base's axes
  Signal signal;
};
struct WorldForce {
  Point at;
  Vector3 amplitude;
  Signal signal;
};
// one velocity coordinate that moves an end of a cut joint
struct Mover {
  Eigen::Index column;
  bool a, b;
};
struct Cut {
  Point a, b;
  std::vector<Mover> movers;
};
struct Moment {
  std::size_t joint;
  Vector3 value;  // in world axes
};
struct Spring {
  Point a, b;
  double stiffness, damping, length;
};
struct Servo {
  std::size_t joint;
  double stiffness, damping, target;
};

class Reader {
 public:
  explicit Reader(const std::string& path) : in_(path) {
    if (!in_) throw std::runtime_error("cannot read " + path);
  }
  std::string word() {
    std::string w;
    if (!(in_ >> w)) throw std::runtime_error("file ends early");
    return w;
  }
  double number() { return std::stod(word()); }
  int count() { return std::stoi(word()); }
  int count(const char* name) {
    if (word() != name) throw std::runtime_error(std::string("expected ") + name);
    return count();
  }
  std::size_t joint() { return static_cast<std::size_t>(count() + 1); }  // ground is joint 0
  Vector3 vector() {
    Vector3 x;
    for (int k = 0; k < 3; ++k) x[k] = number();
    return x;
  }
  Matrix3 matrix() {
    Matrix3 x;
    for (int k = 0; k < 9; ++k) x(k / 3, k % 3) = number();
    return x;
  }
  Point point() {
    const std::size_t j = joint();
    return {j, vector()};
  }
  Signal signal() {
    const double rate = number();
    return {rate, number()};
  }

 private:
  std::ifstream in_;
};

class Problem {
 public:
  explicit Problem(const std::string& path) {
    Reader in(path);
    read_links(in);
    if (in.word() != "gravity") throw std::runtime_error("expected gravity");
    model.gravity.linear() = in.vector();
    for (int k = in.count("bodies"); k > 0; --k) bodies.push_back(in.point());
    for (int k = in.count("wrenches"); k > 0; --k) {
      const std::size_t j = in.joint();
      const Vector3 force = in.vector();
      wrenches_.push_back({j, pin::Force(force, in.vector())});
    }
    for (int k = in.count("actuators"); k > 0; --k) {
      const std::size_t base = in.joint(), slider = in.joint();
      const Vector3 x = in.vector(), axis = in.vector();
      const Vector3 force = in.number() * axis;
      actuators_.push_back({base, slider, pin::Force(force, x.cross(force)), in.signal()});
    }
    for (int k = in.count("forces"); k > 0; --k) {
      const Point at = in.point();
      const Vector3 amplitude = in.vector();
      forces_.push_back({at, amplitude, in.signal()});
    }
    for (int k = in.count("cuts"); k > 0; --k) {
      const Point a = in.point(), b = in.point();
      cuts_.push_back({a, b, movers(a.joint, b.joint)});
    }
    closed_.resize(in.count("closed"), 3);
    for (Eigen::Index k = 0; k < closed_.rows(); ++k) closed_.row(k) = in.vector().transpose();
    for (int k = in.count("moments"); k > 0; --k) {
      const std::size_t j = in.joint();
      moments_.push_back({j, in.vector()});
    }
    for (int k = in.count("springs"); k > 0; --k) {
      const Point a = in.point(), b = in.point();
      const double stiffness = in.number(), damping = in.number();
      springs_.push_back({a, b, stiffness, damping, in.number()});
      damped_ = damped_ || damping != 0;
    }
    for (int k = in.count("servos"); k > 0; --k) {
      const std::size_t j = in.joint();
      const double stiffness = in.number(), damping = in.number();
      servos_.push_back({j, stiffness, damping, in.number()});
    }
    data = pin::Data(model);
    const auto rows = closed_.rows() * static_cast<Eigen::Index>(cuts_.size());
    external_.assign(static_cast<std::size_t>(model.njoints), pin::Force::Zero());
    zero_.setZero(model.nv);
    Y_.setZero(model.nv, rows + 1);
    S_.setZero(rows, rows);
    gamma_.setZero(rows);
    q.setZero(model.nq);
    v.setZero(model.nv);
    a.setZero(model.nv);
  }

  // dx/dt of x = (q, v); quaternions are normalised where they are used, not in x
  void operator()(const State& x, State& rate, double t) {
    load(x);
    accelerate(t);
    std::copy(v.data(), v.data() + model.nv, rate.begin());
    double* out = rate.data();
    const double* u = v.data();
    for (std::size_t j = 1; j < model.joints.size(); ++j) {
      const int nq = model.nqs[j], nv = model.nvs[j];
      if (nq == nv) {
        std::copy(u, u + nv, out);
      } else {
        const int place = nv - 3;  // 3 in front of a free joint's quaternion, 0 of a ball's
        const Eigen::Map<const Eigen::Quaterniond> turn(x.data() + model.idx_qs[j] + place);
        const Eigen::Map<const Vector3> linear(u), w(u + place);
        if (place) Eigen::Map<Vector3>(out).noalias() = data.oMi[j].rotation() * linear;
        const Eigen::Quaterniond half(0.0, 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]);
        Eigen::Map<Eigen::Vector4d>(out + place) = (turn * half).coeffs();
      }
      out += nq;
      u += nv;
    }
    std::copy(a.data(), a.data() + model.nv, out);
    ++evaluations;
  }

  // split x into q (unit quaternions) and v
  void load(const State& x) {
    std::copy(x.begin(), x.begin() + model.nq, q.data());
    std::copy(x.begin() + model.nq, x.end(), v.data());
    for (std::size_t j = 1; j < model.joints.size(); ++j)
      if (model.nqs[j] != model.nvs[j])
        q.segment<4>(model.idx_qs[j] + model.nvs[j] - 3).normalize();
  }

  // M a + h = tau + J^T lambda,  J a = gamma; all columns share one forward substitution
  void accelerate(double t) {
    pin::crba(model, data, q, pin::Convention::WORLD);
    if (damped_) pin::forwardKinematics(model, data, q, v);
    apply_loads(t);
    const Eigen::Index rows = gamma_.size();
    Y_.col(rows) = -pin::rnea(model, data, q, v, zero_, external_);
    for (const Servo& s : servos_) {
      const int at_q = model.idx_qs[s.joint], at_v = model.idx_vs[s.joint];
      Y_(at_v, rows) -= s.stiffness * (q[at_q] - s.target) + s.damping * v[at_v];
    }
    Eigen::Index row = 0;
    for (const Cut& cut : cuts_) {
      close(row, cut);
      row += closed_.rows();
    }
    factor(Y_);
    if (rows) {
      const auto J = Y_.leftCols(rows);
      S_.noalias() = J.transpose() * J;
      gamma_.noalias() -= J.transpose() * Y_.col(rows);
      solver_.compute(S_);
      solver_.solveInPlace(gamma_);
      Y_.col(rows).noalias() += J * gamma_;
    }
    finish();
  }

  // the largest distance between the two points of a cut joint
  double gap(const State& x) {
    load(x);
    pin::forwardKinematics(model, data, q);
    double worst = 0;
    for (const Cut& c : cuts_) worst = std::max(worst, (world(c.a) - world(c.b)).norm());
    return worst;
  }
  Vector3 world(const Point& p) const { return data.oMi[p.joint].act(p.x); }

  pin::Model model;
  pin::Data data;
  std::vector<Point> bodies;
  Eigen::VectorXd q, v, a;
  long evaluations = 0;

 private:
  void read_links(Reader& in) {
    for (int k = in.count("links"); k > 0; --k) {
      const std::string kind = in.word();
      const std::size_t parent = in.joint();
      const Matrix3 R = in.matrix();
      const pin::SE3 placement(R, in.vector());
      const double mass = in.number();
      const Vector3 com = in.vector();
      const pin::Inertia inertia(mass, com, in.matrix());
      const std::string name = "joint" + std::to_string(model.njoints);
      const auto j = model.addJoint(parent, joint(kind), placement, name);
      model.appendBodyToJoint(j, inertia, pin::SE3::Identity());
    }
  }

  static pin::JointModel joint(const std::string& kind) {
    if (kind == "free") return pin::JointModelFreeFlyer();
    if (kind == "ball") return pin::JointModelSpherical();
    if (kind == "turn") return pin::JointModelRZ();
    if (kind == "slide") return pin::JointModelPZ();
    if (kind == "universal")
      return pin::JointModelUniversal(Vector3::UnitX(), Vector3::UnitY());
    throw std::runtime_error("unknown joint " + kind);
  }

  std::vector<Mover> movers(std::size_t a, std::size_t b) const {
    std::vector<Mover> found;
    for (std::size_t j = 1; j < model.joints.size(); ++j) {
      const bool moves_a = supports(j, a), moves_b = supports(j, b);
      for (int k = 0; k < model.nvs[j]; ++k)
        if (moves_a || moves_b) found.push_back({model.idx_vs[j] + k, moves_a, moves_b});
    }
    return found;
  }
  bool supports(std::size_t j, std::size_t end) const {
    while (end > j) end = model.parents[end];
    return end == j;
  }

  void apply_loads(double t) {
    for (auto& f : external_) f.setZero();
    for (const Wrench& w : wrenches_) external_[w.joint] += w.value;
    for (const Actuator& x : actuators_) {
      const pin::Force f = x.signal(t) * x.unit;
      external_[x.base] -= f;
      external_[x.slider] += data.oMi[x.slider].actInv(data.oMi[x.base].act(f));
    }
    for (const WorldForce& x : forces_) {
      const Vector3 amount = x.signal(t) * x.amplitude;
      const Vector3 f = data.oMi[x.at.joint].rotation().transpose() * amount;
      external_[x.at.joint] += pin::Force(f, x.at.x.cross(f));
    }
    for (const Moment& x : moments_) {
      const Vector3 m = data.oMi[x.joint].rotation().transpose() * x.value;
      external_[x.joint] += pin::Force(Vector3::Zero(), m);
    }
    for (const Spring& s : springs_) {
      const Vector3 d = world(s.b) - world(s.a);
      const double now = d.norm();
      double pull = s.stiffness * (now - s.length);
      if (damped_) pull += s.damping * d.dot(speed(s.b) - speed(s.a)) / now;
      push(s.a, pull / now * d);
      push(s.b, -pull / now * d);
    }
  }

  // a force in world axes at a point; ground takes any
  void push(const Point& at, const Vector3& force) {
    if (at.joint == 0) return;
    const Vector3 f = data.oMi[at.joint].rotation().transpose() * force;
    external_[at.joint] += pin::Force(f, at.x.cross(f));
  }
  Vector3 speed(const Point& p) const {
    const pin::Motion& m = data.v[p.joint];
    return data.oMi[p.joint].rotation() * (m.linear() + m.angular().cross(p.x));
  }

  // acceleration of a point for zero joint accelerations; gravity cancels in differences
  Vector3 bias(const Point& p) const {
    const pin::Motion& v = data.v[p.joint];
    const pin::Motion& c = data.a_gf[p.joint];
    const Vector3 speed = v.linear() + v.angular().cross(p.x);
    const Vector3 local = c.linear() + c.angular().cross(p.x) + v.angular().cross(speed);
    return data.oMi[p.joint].rotation() * local;
  }

  void close(Eigen::Index row, const Cut& cut) {
    const Vector3 a = world(cut.a), b = world(cut.b);
    for (const Mover& m : cut.movers) {
      const auto column = data.J.col(m.column);
      const Vector3 linear = column.head<3>(), angular = column.tail<3>();
      Vector3 moved = Vector3::Zero();
      if (m.a) moved += linear + angular.cross(a);
      if (m.b) moved -= linear + angular.cross(b);
      Y_.row(m.column).segment(row, closed_.rows()) = (closed_ * moved).transpose();
    }
    gamma_.segment(row, closed_.rows()) = closed_ * (bias(cut.b) - bias(cut.a));
  }

  // M = U D U^T by branches: Y becomes D^-1/2 U^-1 Y
  void factor(Eigen::MatrixXd& Y) {
    pin::cholesky::decompose(model, data);
    pin::cholesky::Uiv(model, data, Y);
    root_ = data.Dinv.cwiseSqrt();
    Y.array().colwise() *= root_.array();
  }
  void finish() {
    a = root_.cwiseProduct(Y_.col(Y_.cols() - 1));
    pin::cholesky::Utiv(model, data, a);
  }
  Eigen::VectorXd root_;

  std::vector<Wrench> wrenches_;
  std::vector<Actuator> actuators_;
  std::vector<WorldForce> forces_;
  std::vector<Cut> cuts_;
  Eigen::Matrix<double, Eigen::Dynamic, 3> closed_;  // world directions in which cuts are closed
  std::vector<Moment> moments_;
  std::vector<Spring> springs_;
  std::vector<Servo> servos_;
  bool damped_ = false;
  std::vector<pin::Force> external_;
  Eigen::VectorXd zero_, gamma_;
  Eigen::MatrixXd Y_, S_;
  Eigen::LLT<Eigen::MatrixXd> solver_;
};
