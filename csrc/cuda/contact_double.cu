#include "contact.cuh"

DIFFVBD_INSTANTIATE_CONTACT(double)
