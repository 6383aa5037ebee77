#include <algorithm>
#include <vector>

#include "host_call.h"
#include "stochastic.h"
#include "threads.h"

namespace gsplat::stochastic {
namespace {

using OptionalTensors = std::vector<OptionalTensor>;

// Indices of the scene's tensors; `SplatScene` in __init__.py has the same order.
enum SceneTensor { kMeans, kCovars, kOpacities, kQuats, kLogScales, kLogits, kSh, kIndex, kPacked, kChunks, kPackedSh, kTensors };
// Indices of the options; `SampleOptions` in __init__.py has the same order.
enum Option {
  kWidth,
  kHeight,
  kCameraModel,
  kMethod,
  kPixelOrder,
  kFirstSample,
  kSamples,
  kSupersampling,
  kSeed,
  kQueueBytes,
  kOptions
};

// Contiguous tensors of a scene, which the pointers of `scene` refer to.
struct SceneTensors {
  OptionalTensors kept;
  Scene scene = {};

  SceneTensors(const Call& call, const OptionalTensors& given) : kept(kTensors) {
    check(given.size() == kTensors, "splat_samples_ takes ", int(kTensors), " scene tensors, got ", given.size());
    const char* names[] = {"means", "covars", "opacities", "quats",  "log_scales", "logits",
                           "sh",    "index",  "packed",    "chunks", "packed_sh"};
    for (int i = 0; i < kTensors; ++i) {
      const ScalarType type = i == kIndex || i == kPacked ? ScalarType::Int
                              : i == kPackedSh            ? ScalarType::Byte
                                                          : ScalarType::Float;
      kept[size_t(i)] = call.take_optional(given[size_t(i)], type, names[i]);
    }
    const OptionalTensor& packed = kept[kPacked];
    const OptionalTensor& first = packed.has_value() ? packed : kept[kMeans];
    check(first.has_value() && first->dim() == 2, "splat_samples_ needs means [N, 3], or packed splats [N, 4]");
    const int64_t n = scene.count = first->size(0);
    check(n < int64_t(1) << 31, "at most 2^31 - 1 splats can be drawn, got ", n);
    const auto is = [&](SceneTensor i, int64_t rows, int64_t columns) {
      const OptionalTensor& t = kept[size_t(i)];
      if (!t.has_value()) return false;
      check(t->numel() == rows * columns && t->size(0) == rows, names[i], " must have ", rows, " rows of ", columns, " values");
      return true;
    };
    if (is(kIndex, n, 1)) scene.index = kept[kIndex]->const_data_ptr<int32_t>();
    if (packed.has_value()) {
      is(kPacked, n, 4);
      scene.packed = reinterpret_cast<const uint32_t*>(packed->const_data_ptr<int32_t>());
      check(is(kChunks, (n + kChunk - 1) / kChunk, kChunkFloats), "packed splats need chunks");
      scene.chunks = data(kept[kChunks]);
      scene.bases = 1;
      const OptionalTensor& rest = kept[kPackedSh];
      if (rest.has_value()) {
        check(rest->dim() == 3 && rest->size(0) == n && rest->size(2) == 3, "packed_sh must be [N, K - 1, 3]");
        scene.packed_sh = rest->const_data_ptr<uint8_t>();
        scene.bases = int32_t(rest->size(1)) + 1;
      }
    } else {
      is(kMeans, n, 3);
      scene.means = data(kept[kMeans]);
      const bool covariances = is(kCovars, n, 6);
      check(covariances ? is(kOpacities, n, 1) : is(kQuats, n, 4) && is(kLogScales, n, 3) && is(kLogits, n, 1),
            "splats need covars and opacities, or quats, log_scales and logits");
      scene.covars = data(kept[kCovars]);
      if (covariances) {
        scene.opacities = data(kept[kOpacities]);
      } else {
        scene.quats = data(kept[kQuats]);
        scene.log_scales = data(kept[kLogScales]);
        scene.logits = data(kept[kLogits]);
      }
      const OptionalTensor& sh = kept[kSh];
      check(sh.has_value() && sh->dim() == 3 && sh->size(0) == n && sh->size(2) == 3, "sh must be [N, K, 3]");
      scene.sh = data(sh);
      scene.bases = int32_t(sh->size(1));
    }
    while ((scene.degree + 1) * (scene.degree + 1) < scene.bases) ++scene.degree;
    check((scene.degree + 1) * (scene.degree + 1) == scene.bases && scene.degree <= 4,
          "sh must have 1, 4, 9, 16 or 25 coefficients, got ", scene.bases);
  }
};

#if defined(GSPLAT_CUDA)

class Frame {
 public:
  Frame(CudaCall& call, const Scene& scene, const Request& view, int64_t queue_bytes) : call_(call) {
    const int64_t words = view.subpixels() * view.slots;
    frame_ = call.array<uint64_t>(words);
    bytes_ = size_t(words) * sizeof(uint64_t);
    queue_.capacity = std::min(most_in_queue(queue_bytes, view.subpixels()), std::max<int64_t>(scene.count, 1));
    queue_.splats = call.array<Splat>(queue_.capacity);
    queue_.starts = call.array<uint64_t>(queue_.capacity);
    rounds_ = (scene.count + queue_.capacity - 1) / queue_.capacity;
    queue_.rounds = call.array<unsigned long long>(rounds_);
  }

  void draw(const Scene& scene, const Request& view, float* sums) {
    check_cuda(cudaMemsetAsync(frame_, 0xff, bytes_, call_.stream), "clearing the frame");
    check_cuda(cudaMemsetAsync(queue_.rounds, 0, size_t(rounds_) * sizeof(*queue_.rounds), call_.stream), "clearing the queue");
    draw_on_device(scene, view, queue_, frame_, call_.stream);
    resolve_on_device(scene, view, frame_, sums, call_.stream);
  }

 private:
  CudaCall& call_;
  Queue queue_ = {};
  uint64_t* frame_;
  size_t bytes_;
  int64_t rounds_;
};

#else

constexpr int64_t kRows = 1024;             // splats per task of the projection
constexpr int64_t kMinFragments = 1 << 14;  // minimum fragments per task

class Frame {
 public:
  Frame(CpuCall& call, const Scene& scene, const Request& view, int64_t queue_bytes) {
    words_ = view.subpixels() * view.slots;
    frame_ = call.array<uint64_t>(words_);
    const int64_t most = std::min<int64_t>(most_in_queue(queue_bytes, view.subpixels()), std::max<int64_t>(scene.count, 1));
    capacity_ = std::min<int64_t>(most, 1 << 18);
    splats_ = call.array<Splat>(capacity_);
    starts_ = call.array<int64_t>(capacity_ + 1);
  }

  void draw(const Scene& scene, const Request& view, float* sums) {
    std::fill_n(frame_, words_, kEmpty);
    for (int64_t begin = 0; begin < scene.count; begin += capacity_)
      round(scene, view, begin, std::min(begin + capacity_, scene.count));
    torch::stable::parallel_for(0, view.height, 1,
                                [&](int64_t from, int64_t to) { kernels().resolve(scene, view, frame_, sums, from, to); });
  }

 private:
  void round(const Scene& scene, const Request& view, int64_t begin, int64_t end) {
    std::vector<int64_t> written(size_t((end - begin + kRows - 1) / kRows));
    torch::stable::parallel_for(0, int64_t(written.size()), 1, [&](int64_t from, int64_t to) {
      for (int64_t task = from; task < to; ++task) {
        const int64_t first = begin + task * kRows;
        written[size_t(task)] = kernels().project(scene, view, first, std::min(first + kRows, end), splats_ + task * kRows);
      }
    });
    int64_t count = 0, fragments = 0;
    for (size_t task = 0; task < written.size(); ++task)
      for (int64_t i = 0; i < written[task]; ++i) {
        splats_[count] = splats_[int64_t(task) * kRows + i];
        starts_[count++] = fragments;
        fragments += splats_[count - 1].count;
      }
    starts_[count] = fragments;
    if (count == 0) return;
    torch::stable::parallel_for(0, fragments, kMinFragments, [&](int64_t from, int64_t to) {
      kernels().draw(view, splats_, starts_, count, from, to, frame_);
    });
  }

  uint64_t* frame_;
  int64_t words_, capacity_;
  Splat* splats_;
  int64_t* starts_;
};

#endif

void splat_samples_(OptionalTensors scene_tensors, Tensor viewmat_in, Tensor intrinsics_in, Tensor sums,
                    std::vector<int64_t> options) {
  Call call(sums);
  check(options.size() == kOptions, "splat_samples_ takes ", int(kOptions), " options, got ", options.size());
  const SceneTensors tensors(call, scene_tensors);
  const Tensor viewmat = call.floats(viewmat_in, "viewmat"), intrinsics = call.floats(intrinsics_in, "intrinsics");
  check(viewmat.numel() == 16 && intrinsics.numel() == 9, "viewmat must be [4, 4] and intrinsics [3, 3]");
  call.in_place(sums, "sums");
  Request view = {};
  view.viewmat = data(viewmat);
  view.intrinsics = data(intrinsics);
  const int64_t width = options[kWidth], height = options[kHeight], factor = options[kSupersampling];
  check(width >= 1 && height >= 1 && factor >= 1 && width * factor <= 1 << 16 && height * factor <= 1 << 16,
        "a picture may have 1 to 65,536 sub-pixels per side, got ", width * factor, " x ", height * factor);
  check(sums.dim() == 3 && sums.size(0) == height && sums.size(1) == width && sums.size(2) == 5, "sums must be [", height, ", ",
        width, ", 5]");
  view.width = int32_t(width);
  view.height = int32_t(height);
  view.supersampling = int32_t(factor);
  check(view.subpixels() <= kMaxSubpixels, "a picture may have 2^31 sub-pixels, got ", view.subpixels());
  view.camera_model = int32_t(options[kCameraModel]);
  view.method = int32_t(options[kMethod]);
  view.pixel_order = int32_t(options[kPixelOrder] != 0);
  check(!view.pixel_order || (view.method == kFragments && view.camera_model == 0),
        "order by pixel needs stochastic transparency and a pinhole camera");
  const int64_t first = options[kFirstSample], samples = options[kSamples];
  check(first >= 0 && samples >= 0 && first + samples <= int64_t(1) << 31, "samples must be numbered from 0 to 2^31 - 1");
  view.seed[0] = uint32_t(options[kSeed]);
  view.seed[1] = uint32_t(uint64_t(options[kSeed]) >> 32);
  view.slots = view.method == kPoints || samples == 1 ? 1 : kMaxSlots;
  Frame frame(call, tensors.scene, view, options[kQueueBytes]);
  for (int64_t sample = first; sample < first + samples;) {
    const int64_t group = view.slots == 1 ? sample : sample - sample % kMaxSlots;
    const int64_t end = std::min(group + view.slots, first + samples);
    view.sample = uint32_t(group);
    view.active = ((1u << (end - group)) - 1) & ~((1u << (sample - group)) - 1);
    frame.draw(tensors.scene, view, mutable_data(sums));
    sample = end;
  }
  call.finish("splat_samples_");
}

Tensor poisson_draws(Tensor rates_in, int64_t count, int64_t seed) {
  Call call(rates_in);
  const Tensor rates = call.take(rates_in, ScalarType::Double, "rates");
  check(rates.dim() == 1 && count >= 0, "poisson_draws takes rates [R] and a number of draws");
  Tensor out = call.empty({rates.size(0), count}, ScalarType::Long);
#if defined(GSPLAT_CUDA)
  poisson_on_device(rates.const_data_ptr<double>(), rates.size(0), count, uint64_t(seed), out.mutable_data_ptr<int64_t>(),
                    call.stream);
#else
  kernels().poisson(rates.const_data_ptr<double>(), rates.size(0), count, uint64_t(seed), out.mutable_data_ptr<int64_t>());
#endif
  call.finish("poisson_draws");
  return out;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("splat_samples_", GSPLAT_BOX(&splat_samples_));
  m.impl("poisson_draws", GSPLAT_BOX(&poisson_draws));
}

}  // namespace gsplat::stochastic
