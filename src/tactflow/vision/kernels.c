/* Loops over pixels and markers, for tactflow.vision.compiled: one function for each `@kernel` in Python.
 *
 * The loops are in the folder loops, by the rooms of tactflow.vision; here is what Python calls. They are one unit
 * for the compiler, so that those of one room may use what another has.
 *
 * What a loop computes, and the shapes of its arguments, stand at its Python namesake, whose body does the same
 * in NumPy. Arrays are C-contiguous; a loop may rely on the shapes that its callers in Python make. Loops run
 * without Python's lock, and keep nothing between two calls.
 *
 * The module uses only the stable interface of Python 3.11, so that one file serves that and all later versions.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "loops/picture.h"
#include "loops/contact_change.h"
#include "loops/contact_levels.h"
#include "loops/geometry.h"
#include "loops/markers.h"
#include "loops/flow.h"
#include "loops/depth.h"

/* arguments : one word for each. A letter is the type of an array's elements as in the module struct (B ? h i q f d),
 * the digit after it the number of dimensions, and `!` that it is written to; `n` is a whole number, `x` a real one.
 * result : what `out` becomes, `-` nothing, `?` a bool, `n` an int, `2` and `4` a tuple of as many floats. */
typedef struct {
    const char *name, *arguments;
    char result;
    int (*run)(const Arg *, double *);
} Loop;

static const Loop LOOPS[] = {
    {"halve", "B2 n n B2!", '-', halve},
    {"smooth_cells", "B2 f3!", '-', smooth_cells},
    {"sum_tiles", "B2 n q1 h3 q3 f3 f3! f3!", '-', sum_tiles},
    {"find_excess", "f2 f2 x f3 f3 f3", '2', find_excess},
    {"weigh_change", "f3 f2 f3 f2 f3! f3!", '4', weigh_change},
    {"window_change", "B2 n n f2 f3 ?2 f2 f3! x", '-', window_change},
    {"contact_cells", "f2 x x x ?2 n ?2!", 'n', contact_cells},
    {"smooth_range", "f2", '2', smooth_range},
    {"largest_nearby", "f2 x f2!", '-', largest_nearby},
    {"outline_level", "f2 x B2 f2!", '-', outline_level},
    {"draw_level", "f2 n n B2!", '-', draw_level},
    {"largest_deviations", "f3 B2 d2 n", '2', largest_deviations},
    {"fit_light", "f3 f2 f2 f3 f3 f3 f3 f1 f2! x n x x", '-', fit_light},
    {"grow_level_lines", "f2 B2 f1 n i2! f1! i2!", 'n', grow_level_lines},
    {"select_contacts", "i2 f1 i2 i2! i2! x x x x", '2', select_contacts},
    {"fill_region", "i2 n n n n ?2! B3!", '-', fill_region},
    {"sum_pixels", "B2 q1!", '-', sum_pixels},
    {"row_ends", "B2 i2!", 'n', row_ends},
    {"convex_hull", "i2 i2!", '2', convex_hull},
    {"sum_harmonics", "i2 d1 x n d2!", '-', sum_harmonics},
    {"move_to_centroids", "f2 d1 d1 d1 d1 x d2!", '-', move_to_centroids},
    {"cover_spots", "B3 n n B2!", '-', cover_spots},
    {"fill_masked", "B2! B2 B2 q1 q1 n x x x", '-', fill_masked},
    {"weigh_motion", "d2 f1 ?1 q2 d2 x d1! n x x", '?', weigh_motion},
    {"align_marks", "B3 d2 q1 q1 h3 f2 q1 x d2! f1! ?1! x x x n", '-', align_marks},
    {"rate_motion", "d2 ?1 d1 d2 q2 x x x d1! d1! n", '2', rate_motion},
    {"sum_cells", "d2 d3 x d3 n d2 d2! d2! d2!", '-', sum_cells},
    {"compare_light", "f3 d1 x f2 f2 f3 q1 f2! d1!", 'n', compare_light},
    {"compare_points", "f3 d1 d1 d2 d2 d3 x d2! d1! d2! d1! d1!", '-', compare_points},
    {"light_around", "f3 f3 f2 x x f1! d2!", '-', light_around},
    {"relative_change", "B2 B2 n n f1 x f2!", '-', relative_change},
    {"slope_misfit", "f3 f2 B2 x x", '2', slope_misfit},
    {"divergence", "f3 x x x x x x f2!", '-', divergence},
    {"solve_down", "f2! f1 x x", '-', solve_down},
    {"slopes_of_colour", "f3 f3 f1 f1 B2 x f3! n n x", '-', slopes_of_colour},
};
#define COUNT ((int)(sizeof LOOPS / sizeof *LOOPS))
#define MOST_ARGUMENTS 16

/* Whether the elements of a buffer are of the type that a letter names; the C types of int32 and int64 differ. */
static int is_of(const Py_buffer *buffer, char type)
{
    const char given = buffer->format ? buffer->format[0] : 'B';
    if (type == 'q')
        return buffer->itemsize == 8 && (given == 'l' || given == 'q');
    if (type == 'i')
        return buffer->itemsize == 4 && (given == 'l' || given == 'i');
    return given == type && !buffer->format[1];
}

static PyObject *result_of(char result, const double *out)
{
    switch (result) {
    case '?':
        return PyBool_FromLong(out[0] != 0);
    case 'n':
        return PyLong_FromDouble(out[0]);
    case '2':
        return Py_BuildValue("(dd)", out[0], out[1]);
    case '4':
        return Py_BuildValue("(dddd)", out[0], out[1], out[2], out[3]);
    default:
        Py_RETURN_NONE;
    }
}

static PyObject *call(PyObject *which, PyObject *const *given, Py_ssize_t count)
{
    const Loop *loop = LOOPS + PyLong_AsLong(which);
    Arg args[MOST_ARGUMENTS];
    Py_buffer views[MOST_ARGUMENTS];
    PyObject *result = NULL;
    int opened = 0, number = 0;
    const char *word = loop->arguments;
    for (; *word; number++) {
        if (number >= count)
            break;
        Arg *arg = args + number;
        if (*word == 'n') {
            arg->whole = PyLong_AsLongLong(given[number]);
        } else if (*word == 'x') {
            arg->number = PyFloat_AsDouble(given[number]);
        } else {
            Py_buffer *view = views + opened;
            const int flags = PyBUF_FORMAT | PyBUF_C_CONTIGUOUS | (word[2] == '!' ? PyBUF_WRITABLE : 0);
            if (PyObject_GetBuffer(given[number], view, flags) < 0)
                goto done;
            opened++;
            if (view->ndim != word[1] - '0' || !is_of(view, *word)) {
                PyErr_Format(PyExc_TypeError, "%s: argument %d: required an array of type %c and %c dimensions",
                             loop->name, number + 1, *word, word[1]);
                goto done;
            }
            arg->data = view->buf;
            for (int k = 0; k < view->ndim; k++)
                arg->shape[k] = view->shape[k];
        }
        if (PyErr_Occurred())
            goto done;
        while (*word && *word != ' ')
            word++;
        while (*word == ' ')
            word++;
    }
    if (*word || number != count) {
        PyErr_Format(PyExc_TypeError, "%s: required the arguments %s, got %zd", loop->name, loop->arguments, count);
        goto done;
    }
    double out[4] = {0, 0, 0, 0};
    int failed;
    Py_BEGIN_ALLOW_THREADS
    failed = loop->run(args, out);
    Py_END_ALLOW_THREADS
    result = failed ? PyErr_NoMemory() : result_of(loop->result, out);
done:
    while (opened)
        PyBuffer_Release(views + --opened);
    return result;
}

static PyMethodDef METHODS[COUNT];

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "_kernels", "The loops of tactflow.vision in C.", -1, NULL, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__kernels(void)
{
    PyObject *module = PyModule_Create(&MODULE);
    for (int i = 0; module && i < COUNT; i++) {
        METHODS[i] = (PyMethodDef){LOOPS[i].name, (PyCFunction)(void (*)(void))call, METH_FASTCALL, NULL};
        PyObject *which = PyLong_FromLong(i), *loop = which ? PyCFunction_NewEx(METHODS + i, which, NULL) : NULL;
        Py_XDECREF(which);
        if (!loop || PyModule_AddObjectRef(module, LOOPS[i].name, loop) < 0) {
            Py_XDECREF(loop);
            Py_CLEAR(module);
            break;
        }
        Py_DECREF(loop);
    }
    return module;
}
