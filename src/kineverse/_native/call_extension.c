/* CPython extension that calls compiled functions with little overhead.

   It does the same as compilation/evaluator.py, and saves four fifths of the time of a call. */

#include "definitions.h"

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>
#define NPY_NO_DEPRECATED_API NPY_1_7_API_VERSION
#include <numpy/arrayobject.h>
#include <string.h>

static int compute(Function function, const double *x, double **results, int lengthy) {
  const double *arguments[1] = {x};
  int failed;
  if (lengthy) {
    Py_BEGIN_ALLOW_THREADS
    failed = function(arguments, results, NULL, NULL, 0);
    Py_END_ALLOW_THREADS
  } else {
    failed = function(arguments, results, NULL, NULL, 0);
  }
  if (failed) PyErr_SetString(PyExc_RuntimeError, "the compiled function failed");
  return failed;
}

/* The numbers of a vector of n doubles; with *owner set where something else had to be converted to one. */
static const double *vector_of(PyObject *x, npy_intp n, PyObject *convert, PyObject **owner) {
  *owner = NULL;
  if (!PyArray_CheckExact(x) || PyArray_TYPE((PyArrayObject *)x) != NPY_DOUBLE ||
      PyArray_NDIM((PyArrayObject *)x) != 1 || PyArray_DIM((PyArrayObject *)x, 0) != n ||
      !PyArray_ISCARRAY_RO((PyArrayObject *)x)) {
    *owner = x = PyObject_CallOneArg(convert, x);
    if (!x) return NULL;
  }
  return (const double *)PyArray_DATA((PyArrayObject *)x);
}

static void *address_of(PyObject *number) { return PyLong_AsVoidPtr(number); }

/* Where there is NaN in a tuple of arrays (or in one array), let check(vector, arrays) say what it thinks. */
static int checked(PyObject *check, PyObject *vector, PyObject *arrays) {
  if (check == Py_None) return 0;
  const int many = PyTuple_CheckExact(arrays);
  const Py_ssize_t count = many ? PyTuple_GET_SIZE(arrays) : 1;
  for (Py_ssize_t i = 0; i < count; i++) {
    PyArrayObject *array = (PyArrayObject *)(many ? PyTuple_GET_ITEM(arrays, i) : arrays);
    const double *numbers = (const double *)PyArray_DATA(array);
    const npy_intp size = PyArray_SIZE(array);
    for (npy_intp k = 0; k < size; k++) {
      if (numbers[k] == numbers[k]) continue;
      PyObject *said = PyObject_CallFunctionObjArgs(check, vector, arrays, NULL);
      Py_XDECREF(said);
      return said ? 0 : -1;
    }
  }
  return 0;
}

/* ---- Call(address, n, shapes, single, lengthy, convert, check, library): fresh arrays, any thread ---- */

typedef struct {
  PyObject_HEAD
  vectorcallfunc vectorcall;
  Function function;
  npy_intp n;
  int outputs, single, lengthy;
  int *dimensions;
  npy_intp *shapes;
  PyObject *convert, *check, *library;
} Call;

static PyObject *call_vectorcall(PyObject *object, PyObject *const *args, size_t count, PyObject *names) {
  Call *self = (Call *)object;
  if (PyVectorcall_NARGS(count) != 1 || names) {
    PyErr_SetString(PyExc_TypeError, "a function takes one vector or mapping");
    return NULL;
  }
  PyObject *owner, *array = NULL, *result = NULL;
  const double *x = vector_of(args[0], self->n, self->convert, &owner);
  if (!x) return NULL;
  double *results[MOST_OUTPUTS];
  if (!self->single) {
    result = PyTuple_New(self->outputs);
    if (!result) goto failed;
  }
  const npy_intp *shape = self->shapes;
  for (int i = 0; i < self->outputs; i++) {
    array = PyArray_SimpleNew(self->dimensions[i], (npy_intp *)shape, NPY_DOUBLE);
    if (!array) goto failed;
    results[i] = (double *)PyArray_DATA((PyArrayObject *)array);
    if (self->single) result = array;
    else PyTuple_SET_ITEM(result, i, array);
    shape += self->dimensions[i];
  }
  if (compute(self->function, x, results, self->lengthy)) goto failed;
  if (checked(self->check, owner ? owner : args[0], result)) goto failed;
  Py_XDECREF(owner);
  return result;
failed:
  Py_XDECREF(owner);
  Py_XDECREF(result);
  return NULL;
}

static void call_dealloc(PyObject *object) {
  Call *self = (Call *)object;
  PyMem_Free(self->dimensions);
  PyMem_Free(self->shapes);
  Py_XDECREF(self->convert);
  Py_XDECREF(self->check);
  Py_XDECREF(self->library);
  Py_TYPE(object)->tp_free(object);
}

static PyObject *call_new(PyTypeObject *type, PyObject *args, PyObject *names UNUSED) {
  PyObject *address, *shapes, *convert, *check, *library;
  Py_ssize_t n;
  int single, lengthy;
  if (!PyArg_ParseTuple(args, "OnO!ppOOO", &address, &n, &PyTuple_Type, &shapes, &single, &lengthy, &convert,
                        &check, &library))
    return NULL;
  Py_ssize_t outputs = PyTuple_GET_SIZE(shapes), total = 0;
  if (outputs < 1 || outputs > MOST_OUTPUTS) {
    PyErr_SetString(PyExc_ValueError, "too many outputs");
    return NULL;
  }
  for (Py_ssize_t i = 0; i < outputs; i++) total += PyTuple_Size(PyTuple_GET_ITEM(shapes, i));
  Call *self = (Call *)type->tp_alloc(type, 0);
  if (!self) return NULL;
  self->vectorcall = call_vectorcall;
  self->function = (Function)address_of(address);
  self->n = n;
  self->outputs = (int)outputs;
  self->single = single;
  self->lengthy = lengthy;
  self->convert = Py_NewRef(convert);
  self->check = Py_NewRef(check);
  self->library = Py_NewRef(library);
  self->dimensions = PyMem_Calloc(outputs, sizeof(int));
  self->shapes = PyMem_Calloc(total + 1, sizeof(npy_intp));
  if (!self->dimensions || !self->shapes) {
    Py_DECREF(self);
    return PyErr_NoMemory();
  }
  npy_intp *to = self->shapes;
  for (Py_ssize_t i = 0; i < outputs; i++) {
    PyObject *shape = PyTuple_GET_ITEM(shapes, i);
    self->dimensions[i] = (int)PyTuple_GET_SIZE(shape);
    for (Py_ssize_t k = 0; k < self->dimensions[i]; k++) *to++ = PyLong_AsSsize_t(PyTuple_GET_ITEM(shape, k));
  }
  if (PyErr_Occurred()) {
    Py_DECREF(self);
    return NULL;
  }
  return (PyObject *)self;
}

static PyTypeObject CallType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "kineverse.compilation.Call",
    .tp_basicsize = sizeof(Call),
    .tp_dealloc = call_dealloc,
    .tp_vectorcall_offset = offsetof(Call, vectorcall),
    .tp_call = PyVectorcall_Call,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_VECTORCALL,
    .tp_new = call_new,
};

/* ---- Evaluator(address, input, outputs, lengthy, convert, check, library): in place, one thread ---- */

typedef struct {
  PyObject_HEAD
  vectorcallfunc vectorcall;
  Function function;
  double *x;
  npy_intp n;
  int lengthy;
  double **results;
  PyObject *input, *outputs, *convert, *check, *library;
} Evaluator;

static PyObject *evaluator_vectorcall(PyObject *object, PyObject *const *args, size_t count,
                                      PyObject *names) {
  Evaluator *self = (Evaluator *)object;
  const Py_ssize_t given = PyVectorcall_NARGS(count);
  if (given > 1 || names) {
    PyErr_SetString(PyExc_TypeError, "an evaluator takes one vector, or nothing");
    return NULL;
  }
  if (given && args[0] != Py_None) {
    PyObject *owner;
    const double *x = vector_of(args[0], self->n, self->convert, &owner);
    if (!x) return NULL;
    memmove(self->x, x, self->n * sizeof(double));
    Py_XDECREF(owner);
  }
  if (compute(self->function, self->x, self->results, self->lengthy)) return NULL;
  if (checked(self->check, self->input, self->outputs)) return NULL;
  Py_RETURN_NONE;
}

static void evaluator_dealloc(PyObject *object) {
  Evaluator *self = (Evaluator *)object;
  PyMem_Free(self->results);
  Py_XDECREF(self->input);
  Py_XDECREF(self->outputs);
  Py_XDECREF(self->convert);
  Py_XDECREF(self->check);
  Py_XDECREF(self->library);
  Py_TYPE(object)->tp_free(object);
}

static PyObject *evaluator_new(PyTypeObject *type, PyObject *args, PyObject *names UNUSED) {
  PyObject *address, *input, *outputs, *convert, *check, *library;
  int lengthy;
  if (!PyArg_ParseTuple(args, "OO!O!pOOO", &address, &PyArray_Type, &input, &PyTuple_Type, &outputs, &lengthy,
                        &convert, &check, &library))
    return NULL;
  Evaluator *self = (Evaluator *)type->tp_alloc(type, 0);
  if (!self) return NULL;
  self->vectorcall = evaluator_vectorcall;
  self->function = (Function)address_of(address);
  self->x = (double *)PyArray_DATA((PyArrayObject *)input);
  self->n = PyArray_SIZE((PyArrayObject *)input);
  self->lengthy = lengthy;
  self->input = Py_NewRef(input);
  self->outputs = Py_NewRef(outputs);
  self->convert = Py_NewRef(convert);
  self->check = Py_NewRef(check);
  self->library = Py_NewRef(library);
  const Py_ssize_t count = PyTuple_GET_SIZE(outputs);
  self->results = PyMem_Calloc(count + 1, sizeof(double *));
  if (!self->results) {
    Py_DECREF(self);
    return PyErr_NoMemory();
  }
  for (Py_ssize_t i = 0; i < count; i++)
    self->results[i] = (double *)PyArray_DATA((PyArrayObject *)PyTuple_GET_ITEM(outputs, i));
  if (PyErr_Occurred()) {
    Py_DECREF(self);
    return NULL;
  }
  return (PyObject *)self;
}

static PyObject *evaluator_repr(PyObject *object) {
  Evaluator *self = (Evaluator *)object;
  return PyUnicode_FromFormat("Evaluator(%zd inputs -> %zd outputs)", (Py_ssize_t)self->n,
                              PyTuple_GET_SIZE(self->outputs));
}

static PyMemberDef evaluator_members[] = {
    {"input", T_OBJECT_EX, offsetof(Evaluator, input), READONLY, "The vector that is evaluated at."},
    {"outputs", T_OBJECT_EX, offsetof(Evaluator, outputs), READONLY, "The arrays that calls rewrite."},
    {0},
};

static PyTypeObject EvaluatorType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "kineverse.compilation.Evaluator",
    .tp_basicsize = sizeof(Evaluator),
    .tp_dealloc = evaluator_dealloc,
    .tp_repr = evaluator_repr,
    .tp_vectorcall_offset = offsetof(Evaluator, vectorcall),
    .tp_call = PyVectorcall_Call,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_VECTORCALL,
    .tp_members = evaluator_members,
    .tp_new = evaluator_new,
};

static struct PyModuleDef definition = {
    .m_base = PyModuleDef_HEAD_INIT, .m_name = "kineverse_native", .m_size = -1};

PyMODINIT_FUNC PyInit_kineverse_native(void) {
  import_array();
  if (PyType_Ready(&CallType) < 0 || PyType_Ready(&EvaluatorType) < 0) return NULL;
  PyObject *module = PyModule_Create(&definition);
  if (!module) return NULL;
  if (PyModule_AddObjectRef(module, "Call", (PyObject *)&CallType) < 0 ||
      PyModule_AddObjectRef(module, "Evaluator", (PyObject *)&EvaluatorType) < 0) {
    Py_DECREF(module);
    return NULL;
  }
  return module;
}
