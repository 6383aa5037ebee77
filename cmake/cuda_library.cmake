# gsplat_core_cuda: the CUDA kernels in a separate library, so that the CPU library has no CUDA dependency.
#
# The compiler is the first of: CMAKE_CUDA_COMPILER or $CUDACXX, the compiler that `make cuda` installs in build/cuda-toolkit
# (NVIDIA's pip packages), nvcc on the PATH. CMake's FindCUDAToolkit requires a complete toolkit and is not used.
set(CUDA_PACKAGES ${CMAKE_CURRENT_SOURCE_DIR}/build/cuda-toolkit/nvidia/cu13)
string(STRIP "$ENV{CUDACXX}" COMPILER_ASKED_FOR)  # may be set but empty
if(NOT CMAKE_CUDA_COMPILER AND COMPILER_ASKED_FOR STREQUAL "" AND EXISTS ${CUDA_PACKAGES}/bin/nvcc)
  set(CMAKE_CUDA_COMPILER ${CUDA_PACKAGES}/bin/nvcc)
endif()
if(CMAKE_CUDA_COMPILER MATCHES "^${CUDA_PACKAGES}/")
  set(ENV{LIBRARY_PATH} "${CUDA_PACKAGES}/lib:$ENV{LIBRARY_PATH}")  # CMake tests the compiler by linking a program
endif()
# portable: all supported architectures, for distributed libraries. The front end runs once for compute capability 8.x and once
# for 9.0 and later, because the kernels only distinguish GPUs with and without the instructions of 9.0.
if(INTRASPLAT_CUDA_ARCHITECTURES STREQUAL "portable")
  set(CMAKE_CUDA_ARCHITECTURES OFF)
  set(PORTABLE_CODE "--generate-code=arch=compute_80,code=[sm_80,sm_86,sm_89]"
      "--generate-code=arch=compute_90,code=[sm_90,sm_100,sm_120,compute_90]")
else()
  set(CMAKE_CUDA_ARCHITECTURES ${INTRASPLAT_CUDA_ARCHITECTURES})
endif()
enable_language(CUDA)
set(CMAKE_CUDA_STANDARD 20)
set(CMAKE_CUDA_STANDARD_REQUIRED ON)

find_library(TORCH_CUDA_LIBRARY torch_cuda PATHS ${TORCH_ROOT}/lib NO_DEFAULT_PATH)
if(NOT TORCH_CUDA_LIBRARY)
  message(FATAL_ERROR "the torch in ${TORCH_ROOT} was built without CUDA; install one with CUDA, or leave INTRASPLAT_CUDA off")
endif()

# Headers and the static runtime are found relative to the compiler, whose folder may be a link (/usr/local/cuda/bin).
file(REAL_PATH ${CMAKE_CUDA_COMPILER} CUDA_COMPILER_PATH)
cmake_path(GET CUDA_COMPILER_PATH PARENT_PATH CUDA_BIN)
cmake_path(GET CUDA_BIN PARENT_PATH CUDA_ROOT)
find_path(CUDA_INCLUDE cuda_runtime.h PATHS ${CUDA_ROOT}/include ${CUDA_ROOT}/targets/x86_64-linux/include
          ${CUDA_ROOT}/targets/sbsa-linux/include REQUIRED NO_DEFAULT_PATH)
find_library(CUDA_RUNTIME NAMES libcudart_static.a PATHS ${CUDA_ROOT}/lib ${CUDA_ROOT}/lib64
             ${CUDA_ROOT}/targets/x86_64-linux/lib ${CUDA_ROOT}/targets/sbsa-linux/lib REQUIRED NO_DEFAULT_PATH)

file(GLOB_RECURSE CUDA_SOURCES CONFIGURE_DEPENDS gsplat_core/*.cu)
add_core_library(gsplat_core_cuda ${CUDA_SOURCES} ${CUDA_HOST_SOURCES})
target_compile_definitions(gsplat_core_cuda PRIVATE ${CORE_DEFINITIONS} GSPLAT_CUDA GSPLAT_ISA=device)
# Device functions are unused in the host pass; Clang warns about each of them.
target_compile_options(gsplat_core_cuda PRIVATE
  $<$<COMPILE_LANGUAGE:CXX>:${CORE_FLAGS}>
  $<$<COMPILE_LANGUAGE:CUDA>:${PORTABLE_CODE} --expt-relaxed-constexpr --extended-lambda -Xcompiler=-fvisibility=hidden,-Wall,-Wno-unused-function>)
target_include_directories(gsplat_core_cuda PRIVATE gsplat_core/native)
target_include_directories(gsplat_core_cuda SYSTEM PRIVATE ${TORCH_ROOT}/include
                           $<$<COMPILE_LANGUAGE:CXX>:${CUDA_INCLUDE}>)
target_precompile_headers(gsplat_core_cuda PRIVATE ${PRECOMPILED})
find_package(Threads REQUIRED)
target_link_libraries(gsplat_core_cuda PRIVATE ${TORCH_CPU_LIBRARY} ${TORCH_CUDA_LIBRARY} ${CUDA_RUNTIME} Threads::Threads dl rt)
# The static runtime is linked by its path. The library then depends on the CUDA driver only, with any toolkit.
set_target_properties(gsplat_core_cuda PROPERTIES LINKER_LANGUAGE CXX CUDA_RUNTIME_LIBRARY None
                      CUDA_VISIBILITY_PRESET hidden)
