// One classical Runge-Kutta step of the published single track for n cars; arrays of each quantity, no branches.
#include <cmath>

struct Car { double m, Iz, a, b, mu, B, C; };

// The compiler would make one complex function of sin and cos of the same angle, which has no vector form.
template <typename T> static inline T cosine(T x) { return std::sin(x + T(1.57079632679489661923)); }

template <typename T>
static void step(long n, const Car& car, const T* __restrict V, const T* __restrict beta, const T* __restrict r,
                 const T* __restrict delta, const T* __restrict Fxr, const T* __restrict dt,
                 T* __restrict V_end, T* __restrict beta_end, T* __restrict r_end) {
  const T m = car.m, a = car.a, b = car.b, B = car.B, C = car.C, per_m = 1 / m, per_Iz = 1 / T(car.Iz);
  const T front = T(car.mu * car.m * 9.81 * car.b / (car.a + car.b));
  const T rear = T(car.mu * car.m * 9.81 * car.a / (car.a + car.b));
#pragma omp simd
  for (long i = 0; i < n; i++) {
    const T h = dt[i], d = delta[i], F = Fxr[i], V0 = V[i], beta0 = beta[i], r0 = r[i];
    const T sin_delta = std::sin(d), cos_delta = cosine(d);
    T v = V0, be = beta0, w = r0, sum_v = 0, sum_be = 0, sum_w = 0;
#pragma GCC unroll 4
    for (int k = 0; k < 4; k++) {
      const T sin_beta = std::sin(be), cos_beta = cosine(be), per_vx = 1 / (v * cos_beta), vy = v * sin_beta;
      const T Fyf = -front * std::sin(C * std::atan(B * (std::atan((vy + a * w) * per_vx) - d)));
      const T Fyr = -rear * std::sin(C * std::atan(B * std::atan((vy - b * w) * per_vx)));
      const T sin_front = sin_delta * cos_beta - cos_delta * sin_beta;
      const T cos_front = cos_delta * cos_beta + sin_delta * sin_beta;
      const T dv = (-Fyf * sin_front + Fyr * sin_beta + F * cos_beta) * per_m;
      const T dbe = (Fyf * cos_front + Fyr * cos_beta - F * sin_beta) * per_m / v - w;
      const T dw = (a * Fyf * cos_delta - b * Fyr) * per_Iz;
      const T weight = (k == 1 || k == 2) ? 2 : 1, ahead = (k == 2) ? h : h / 2;
      sum_v += weight * dv, sum_be += weight * dbe, sum_w += weight * dw;
      v = V0 + ahead * dv, be = beta0 + ahead * dbe, w = r0 + ahead * dw;
    }
    V_end[i] = V0 + h / 6 * sum_v, beta_end[i] = beta0 + h / 6 * sum_be, r_end[i] = r0 + h / 6 * sum_w;
  }
}

extern "C" {
void step_float64(long n, const Car* car, const double* V, const double* beta, const double* r, const double* delta,
                  const double* Fxr, const double* dt, double* V_end, double* beta_end, double* r_end) {
  step<double>(n, *car, V, beta, r, delta, Fxr, dt, V_end, beta_end, r_end);
}
void step_float32(long n, const Car* car, const float* V, const float* beta, const float* r, const float* delta,
                  const float* Fxr, const float* dt, float* V_end, float* beta_end, float* r_end) {
  step<float>(n, *car, V, beta, r, delta, Fxr, dt, V_end, beta_end, r_end);
}
}
