/* Evaluation of a program in a computation of XLA, by its foreign function interface (`jax.ffi`). The argument
   has the inputs along its last dimension and a point for each index of the others; there is a result for each
   output. Arrays are of doubles, or of floats that are computed in double. */

#include <sched.h>
#include <stdatomic.h>
#include <xla/ffi/api/c_api.h>

#include "batch.c"

enum {
  CONVERTED = 64,                                    /* rows of floats that are converted at once */
  PIECE = (250000 / (OPERATIONS + 20) + 1) * 8,      /* rows for a thread: 100 us of work, twice what it takes to wake it */
  STREAMED = 8 << 20                                 /* [bytes]; larger results are written past the caches */
};

/* Rows that several threads share. It lives until the last thread has let go of it. */
typedef struct {
  const void *in;
  void *out[OUTPUTS];
  long long rows;
  int is_double, streaming;
  atomic_llong next, done; /* rows that are taken, and that are computed */
  atomic_int failed, users;
} Job;

static const int widths[] = {SIZES};

/* Compute rows of floats in double; return 1 if there is no memory. */
static int compute_floats(const Job *job, long long first, long long end) {
  double *in = malloc(CONVERTED * (INPUTS + RESULTS) * sizeof(double)), *out[OUTPUTS];
  if (!in) return 1;
  out[0] = in + CONVERTED * INPUTS;
  for (int k = 1; k < OUTPUTS; k++) out[k] = out[k - 1] + CONVERTED * widths[k - 1];
  int failed = 0;
  for (long long row = first; row < end && !failed; row += CONVERTED) {
    const long long count = end - row < CONVERTED ? end - row : CONVERTED;
    const float *from = (const float *)job->in + row * INPUTS;
    for (long long i = 0; i < count * INPUTS; i++) in[i] = from[i];
    failed = kineverse_batch(in, out, count, 0);
    for (int k = 0; k < OUTPUTS; k++) {
      float *to = (float *)job->out[k] + row * widths[k];
      for (long long i = 0; i < count * widths[k]; i++) to[i] = (float)out[k][i];
    }
  }
  free(in);
  return failed;
}

static int compute_doubles(const Job *job, long long first, long long end) {
  double *out[OUTPUTS];
  for (int k = 0; k < OUTPUTS; k++) out[k] = (double *)job->out[k] + first * widths[k];
  return kineverse_batch((const double *)job->in + first * INPUTS, out, end - first, job->streaming);
}

static void work(Job *job) {
  for (;;) {
    const long long first = atomic_fetch_add(&job->next, PIECE);
    if (first >= job->rows) return;
    const long long end = job->rows - first < PIECE ? job->rows : first + PIECE;
    if ((job->is_double ? compute_doubles : compute_floats)(job, first, end)) atomic_store(&job->failed, 1);
    atomic_fetch_add(&job->done, end - first);
  }
}

static void release(Job *job) {
  if (atomic_fetch_sub(&job->users, 1) == 1) free(job);
}

static void help(void *job) {
  work(job);
  release(job);
}

static XLA_FFI_Error *failure(const XLA_FFI_Api *api, XLA_FFI_Error_Code code, const char *message) {
  XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, 0, message, code};
  return api->XLA_FFI_Error_Create(&args);
}

/* Return 1 if XLA made no error. */
static int succeeded(const XLA_FFI_Api *api, XLA_FFI_Error *error) {
  if (!error) return 1;
  XLA_FFI_Error_Destroy_Args args = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, 0, error};
  api->XLA_FFI_Error_Destroy(&args);
  return 0;
}

/* Ask XLA's threads for help, as many as are worth it. Those that come too late find no rows. */
static void share(Job *job, const XLA_FFI_CallFrame *frame) {
  const XLA_FFI_Api *api = frame->api;
  int64_t threads = 0;
  XLA_FFI_ThreadPool_NumThreads_Args count = {
      XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, 0, frame->ctx, &threads};
  if (job->rows < 2 * PIECE || !succeeded(api, api->XLA_FFI_ThreadPool_NumThreads(&count))) return;
  if (threads > job->rows / PIECE) threads = job->rows / PIECE;
  for (int64_t i = 1; i < threads; i++) {
    atomic_fetch_add(&job->users, 1);
    XLA_FFI_ThreadPool_Schedule_Args task = {
        XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, 0, frame->ctx, help, job};
    if (!succeeded(api, api->XLA_FFI_ThreadPool_Schedule(&task))) {
      release(job);
      return;
    }
  }
}

static XLA_FFI_Error *run(const XLA_FFI_CallFrame *frame) {
  const XLA_FFI_Api *api = frame->api;
  const XLA_FFI_Buffer *in = frame->args.args[0];
  const int is_double = in->dtype == XLA_FFI_DataType_F64;
  if (frame->args.size != 1 || frame->rets.size != OUTPUTS || in->rank < 1 || in->dims[in->rank - 1] != INPUTS ||
      (!is_double && in->dtype != XLA_FFI_DataType_F32))
    return failure(api, XLA_FFI_Error_Code_INVALID_ARGUMENT, "Arrays are not those of the compiled program.");
  Job *job = malloc(sizeof(Job));
  if (!job) return failure(api, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, "There is no memory.");
  *job = (Job){.in = in->data, .rows = 1, .is_double = is_double, .users = 1};
  for (int64_t i = 0; i + 1 < in->rank; i++) job->rows *= in->dims[i];
  for (int k = 0; k < OUTPUTS; k++) job->out[k] = ((XLA_FFI_Buffer *)frame->rets.rets[k])->data;
  job->streaming = job->rows * RESULTS * (long long)sizeof(double) > STREAMED;
  share(job, frame);
  work(job);
  while (atomic_load(&job->done) < job->rows) sched_yield();
  const int failed = atomic_load(&job->failed);
  release(job);
  return failed ? failure(api, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, "There is no memory.") : 0;
}

/* The handler. XLA asks it for the version of its interface first. */
EXPORTED XLA_FFI_Error *kineverse_xla_ffi(XLA_FFI_CallFrame *frame) {
  const XLA_FFI_Extension_Base *extension = frame->extension_start;
  if (extension && extension->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    memset(&metadata->traits, 0, sizeof(XLA_FFI_Metadata) - offsetof(XLA_FFI_Metadata, traits));
    return 0;
  }
  return run(frame);
}
