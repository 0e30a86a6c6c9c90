/* What one core gives: `roofline BYTES` prints the bytes a second of a triad over three arrays of
   BYTES in all, `roofline 0` the float32 operations a second of independent fused multiply-adds. */
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

typedef float vector __attribute__((vector_size(64)));
enum { LANES = 16, CHAINS = 8, TURNS = 1 << 22 };

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

static double triad(size_t bytes) {
  size_t n = bytes / (3 * sizeof(float)), turns = 1 + (1u << 28) / (3 * n * sizeof(float));
  float *a = malloc(n * sizeof *a), *b = malloc(n * sizeof *b), *c = malloc(n * sizeof *c);
  if (!a || !b || !c) return 0.0;
  for (size_t k = 0; k < n; k++) a[k] = 0.0f, b[k] = 1.0f, c[k] = 2.0f;
  double begin = now();
  for (size_t turn = 0; turn < turns; turn++) {
    for (size_t k = 0; k < n; k++) a[k] = b[k] + 3.0f * c[k];
    __asm__ volatile("" : : "r"(a) : "memory");
  }
  double taken = now() - begin;
  free(a), free(b), free(c);
  return 3.0 * n * sizeof(float) * turns / taken;
}

static double multiply_adds(void) {
  vector x[CHAINS], scale, shift;
  for (int lane = 0; lane < LANES; lane++) {
    scale[lane] = 0.999f, shift[lane] = 0.001f;
    for (int k = 0; k < CHAINS; k++) x[k][lane] = k + lane;
  }
  double begin = now();
  for (int turn = 0; turn < TURNS; turn++)
    for (int k = 0; k < CHAINS; k++) x[k] = x[k] * scale + shift;
  double taken = now() - begin;
  volatile float kept = 0.0f;
  for (int k = 0; k < CHAINS; k++) kept += x[k][0];
  return 2.0 * LANES * CHAINS * TURNS / taken;
}

int main(int count, char **words) {
  size_t bytes = count > 1 ? strtoull(words[1], 0, 10) : 0;
  printf("%.6g a second\n", bytes ? triad(bytes) : multiply_adds());
  return 0;
}
