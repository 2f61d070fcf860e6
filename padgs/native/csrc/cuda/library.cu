// Version and capabilities of the library.
#include "arguments.h"
#include "device.cuh"

namespace padgs {
namespace {

__global__ void __launch_bounds__(kWarp) empty_kernel(int32_t *) {}

}  // namespace
}  // namespace padgs

using namespace padgs;

// Bytes of the structures that cross the border, in the order of STRUCTURES in padgs/native/cuda.py.
PADGS_API int64_t padgs_cuda_structure_bytes(int32_t index) {
  const size_t bytes[] = {sizeof(Queue),
                          sizeof(ProjectArguments),
                          sizeof(ProjectGradientArguments),
                          sizeof(SortArguments),
                          sizeof(BinArguments),
                          sizeof(BlendInputs),
                          sizeof(BlendGradientInputs),
                          sizeof(RemovalInputs),
                          sizeof(DeviceLossArguments),
                          sizeof(DeviceSplatArguments),
                          sizeof(DeviceDecodeArguments),
                          sizeof(DeviceDecodeGradientArguments)};
  return index >= 0 && size_t(index) < sizeof(bytes) / sizeof(*bytes) ? int64_t(bytes[index]) : -1;
}

// The kind of device whose memory the library takes, as torch calls it.
PADGS_API const char *padgs_cuda_device_type() {
#if defined(PADGS_EMULATED)
  return "cpu";
#else
  return "cuda";
#endif
}

// Architectures that the library was compiled for, as "80 86 89 90".
PADGS_API const char *padgs_cuda_architectures() {
#if defined(PADGS_ARCHITECTURES)
  return PADGS_ARCHITECTURES;
#else
  return "";
#endif
}

// The versions of CUDA, 1000 major + 10 minor, that the driver goes up to (0: there is none) and that this was built with.
PADGS_API void padgs_cuda_versions(int32_t *driver, int32_t *built_with) {
#if defined(PADGS_EMULATED)
  *driver = *built_with = 0;
#else
  *built_with = CUDART_VERSION;
  if (cudaDriverGetVersion(driver) != cudaSuccess) *driver = 0;
  cudaGetLastError();
#endif
}

// Whether the kernels can run on a device: 0, or an error such as that none was compiled for it.
PADGS_API int padgs_cuda_check(const Queue *queue) {
  return on_device(*queue, [&] {
    launch(empty_kernel, 1, kWarp, *queue, (int32_t *)nullptr);
    return 0;
  });
}

PADGS_API const char *padgs_cuda_error(int code) {
#if defined(PADGS_EMULATED)
  return code == 2 ? "out of memory" : code ? "error" : "no error";
#else
  return cudaGetErrorString(cudaError_t(code));
#endif
}
