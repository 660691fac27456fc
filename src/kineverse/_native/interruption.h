/* End of work that lasts: when its time is up, and when a signal such as Ctrl-C arrives. */
#pragma once
#include "definitions.h"

#include <math.h>
#include <time.h>

/* Functions of Python, and the exception that a handler of signals has raised: type, value and traceback. */
typedef struct {
  int (*take_gil)(void);
  void (*release_gil)(int);
  int (*check_signals)(void);
  void (*fetch)(void **, void **, void **);
  void *type, *value, *traceback;
} Signals;

static Signals *signals;

EXPORTED void kineverse_watch_signals(Signals *s) { signals = s; }

/* Work that is over when its time is up, or a handler has raised an exception. Times of a clock [s]. */
typedef struct {
  double end, next; /* next: when signals are looked at again */
  int calls, over;
} Watch;

enum { GOING_ON, LATE, INTERRUPTED };

/* Nobody notices a delay of so many seconds, and to ask takes microseconds, or until other threads let us. */
#define ASKING 0.05

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void watch_begin(Watch *w, double seconds) {
  const double begin = now();
  w->end = begin + seconds;
  w->next = begin + ASKING;
  w->calls = 0;
  w->over = GOING_ON;
}

static __attribute__((noinline)) int look_at_clock(Watch *w) {
  if (w->over) return w->over;
  const double t = now();
  if (t > w->end) w->over = LATE;
  if (t <= w->next || !signals) return w->over;
  const int gil = signals->take_gil();
  if (signals->check_signals()) {
    signals->fetch(&signals->type, &signals->value, &signals->traceback);
    w->over = INTERRUPTED;
  }
  signals->release_gil(gil);
  w->next = now() + ASKING;
  return w->over;
}

/* As look_at_clock, for loops whose rounds take microseconds: it looks in one round of 32. */
static inline UNUSED int is_over(Watch *w) { return w->over || ((++w->calls & 31) == 0 && look_at_clock(w)); }
