#include "scene_forward.cuh"

DIFFVBD_INSTANTIATE_SCENE_FORWARD(double)
