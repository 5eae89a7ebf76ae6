// OpenPCDet's functions for a CPU, compiled from the sources of its checkout; its setup.py compiles them with nvcc only.
// The one function that is ours, points_in_boxes_launcher, asks for each point what its points_in_boxes_cpu asks.
#include <torch/extension.h>

#define __device__  // a word of CUDA in its sources for a CPU
#undef PYBIND11_MODULE
#define PYBIND11_MODULE(name, m) [[maybe_unused]] static void bind_both_devices(pybind11::module_ m)
#include "roiaware_pool3d/src/roiaware_pool3d.cpp"
#include "iou3d_nms/src/iou3d_cpu.cpp"

[[noreturn]] static void needs_gpu() { throw std::runtime_error("this function of OpenPCDet needs a GPU"); }

void roiaware_pool3d_launcher(int, int, int, int, int, int, int, const float *, const float *, const float *, int *,
                              int *, float *, int) { needs_gpu(); }

void roiaware_pool3d_backward_launcher(int, int, int, int, int, int, const int *, const int *, const float *, float *,
                                       int) { needs_gpu(); }

void points_in_boxes_launcher(int batch, int boxes, int points, const float *box, const float *point, int *found) {
    float x = 0, y = 0;
    for (int i = 0; i < batch * points; i++)
        for (int k = 0; k < boxes && found[i] < 0; k++)
            if (check_pt_in_box3d_cpu(point + i * 3, box + (i / points * boxes + k) * 7, x, y)) found[i] = k;
}

extern "C" PyObject *PyInit_openpcdet_cpu() {
    static pybind11::module_::module_def definition;
    auto m = pybind11::module_::create_extension_module("openpcdet_cpu", nullptr, &definition);
    m.def("points_in_boxes_cpu", &points_in_boxes_cpu);
    m.def("points_in_boxes_gpu", &points_in_boxes_gpu);
    m.def("boxes_iou_bev_cpu", &boxes_iou_bev_cpu);
    m.def("boxes_aligned_iou_bev_cpu", &boxes_aligned_iou_bev_cpu);
    return m.release().ptr();
}
