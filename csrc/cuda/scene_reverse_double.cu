#include "scene_reverse.cuh"

DIFFVBD_INSTANTIATE_SCENE_REVERSE(double)
