// Host code of `rasterization()` in one call: from Gaussians to the outputs of gsplat's projection, tile intersection
// and compositing.
#include "scene_inputs.h"

namespace gsplat::rasterization {
namespace {

constexpr int64_t kFewTiles = 4096;  // up to this number of tiles every counter has its own 128 bytes

// Scratch memory of one forward pass, in one allocation.
struct ListScratch {
  Arena arena;
  frame::Scratch lists;
  uint32_t* visible_counts;  // [images * blocks], packed
  int32_t* visible_starts;   // [images * blocks + 1], packed
  uint64_t* visible_states;
  uint64_t* keys;            // [capacity], as in Lists
  int32_t* instance_splats;  // [capacity]
  float* records;            // [splats, kSplatFloats], as in Splats; this and the next are kept as tensors for the gradient
  int32_t* splat_starts;     // [splats + 1]

  ListScratch(const Allocator& memory, const Scene& scene, bool packed, bool training, int64_t capacity, cudaStream_t stream) {
    const int64_t tiles = scene.images() * scene.tiles(), blocks = scene.images() * scene.blocks();
    const int64_t splats = scene.images() * scene.gaussians;
    const int32_t stride = tiles <= kFewTiles ? 32 : 8;
    const int64_t states = frame::scan_state_count(tiles, blocks), visible = packed ? frame::scan_state_count(blocks, 0) : 0;
    const size_t zeros = arena.place<uint64_t>(states + visible + tiles * stride / 2), zeros_end = arena.size();
    const size_t footprints = arena.place<uint2>(splats), depths = arena.place<uint32_t>(splats);
    const size_t sums = arena.place<uint32_t>(blocks), starts = arena.place<uint32_t>(blocks);
    const size_t counts = arena.place<uint32_t>(packed ? blocks : 0), of_visible = arena.place<int32_t>(packed ? blocks + 1 : 0);
    const size_t keys_at = arena.place<uint64_t>(capacity), instances = arena.place<int32_t>(capacity);
    const size_t records_at = arena.place<float>(training ? 0 : splats * kSplatFloats);
    const size_t splat_starts_at = arena.place<int32_t>(training ? 0 : splats + 1);
    arena.make(memory);
    records = arena.at<float>(records_at);
    splat_starts = arena.at<int32_t>(splat_starts_at);
    visible_counts = arena.at<uint32_t>(counts);
    visible_starts = arena.at<int32_t>(of_visible);
    keys = arena.at<uint64_t>(keys_at);
    instance_splats = arena.at<int32_t>(instances);
    uint64_t* const first = arena.at<uint64_t>(zeros);
    visible_states = first + states;
    lists = {.footprints = arena.at<uint2>(footprints),
             .depths = arena.at<uint32_t>(depths),
             .counters = reinterpret_cast<uint32_t*>(visible_states + visible),
             .scan_states = first,
             .block_counts = arena.at<uint32_t>(sums),
             .block_starts = arena.at<uint32_t>(starts),
             .counter_stride = stride};
    check_cuda(cudaMemsetAsync(first, 0, zeros_end - zeros, stream), "clearing the counts");
  }
};

// Count the visible splats before each block of Gaussians (`visible_starts`), and in all (`rows`).
void scan_visible(const Scene& scene, const Splats& splats, const ListScratch& scratch, NumberFromGpu& rows,
                  cudaStream_t stream) {
  const int64_t blocks = scene.images() * scene.blocks();
  if (blocks == 0) {
    rows.set(0);
    return;
  }
  count_visible(scene, splats, scratch.visible_counts, stream);
  frame::Scene counters = {};
  counters.tile_width = int32_t(blocks);
  counters.tile_height = 1;
  frame::Lists lists = {};
  lists.tile_offsets = scratch.visible_starts;
  lists.status = rows.written_by_kernel();
  lists.capacity = kMostInts;
  frame::Scratch of_counters = {};
  of_counters.counters = scratch.visible_counts;
  of_counters.scan_states = scratch.visible_states;
  of_counters.counter_stride = 1;
  frame::scan(counters, lists, of_counters, stream);
}

// One forward pass. It holds all returned tensors; `outputs` returns them in order.
struct Pass {
  const CudaCall& call;
  const Allocator memory;
  const Scene& scene;
  const Sizes image_dims;
  const bool packed, training;
  const Tensor none;
  Tensor means2d, depths, conics, opacities, radii, tiles_per_gauss, records, splat_starts, offsets;
  Tensor image, alphas, expected, last;
  Tensor flatten_ids, isect_ids, sorted;
  Tensor batch_ids, camera_ids, gaussian_ids, row_of, dense_radii, splat_ids;

  Pass(const CudaCall& call_, const Tensor& on, const Scene& scene_, const Sizes& image_dims_, bool packed_, bool training_)
      : call(call_),
        memory(on),
        scene(scene_),
        image_dims(image_dims_),
        packed(packed_),
        training(training_),
        none(memory.floats({0})) {
    for (Tensor* t :
         {&opacities, &expected, &last, &sorted, &batch_ids, &camera_ids, &gaussian_ids, &row_of, &dense_radii, &splat_ids})
      *t = none;
  }

  Sizes of_images(std::initializer_list<int64_t> more) const {
    Sizes sizes = image_dims;
    sizes.insert(sizes.end(), more);
    return sizes;
  }

  // Render with tile lists of `capacity` instances; 0 waits for their length and takes that. Returns false if the capacity
  // was exceeded. The results are then incomplete and must not be used.
  bool run(int64_t capacity) {
    const int64_t n = scene.gaussians;
    const bool own_opacities = scene.antialiased;
    ListScratch scratch(memory, scene, packed, training, capacity, call.stream);  // its memory is cleared during the allocations
    means2d = memory.floats(of_images({n, 2}));
    depths = memory.floats(of_images({n}));
    conics = memory.floats(of_images({n, 3}));
    radii = memory.ints(of_images({n, 2}));
    tiles_per_gauss = memory.ints(of_images({n}));
    if (own_opacities) opacities = memory.floats(of_images({n}));
    if (training) {
      records = memory.floats({scene.images() * n, kSplatFloats});
      splat_starts = memory.ints({scene.images() * n + 1});
      scratch.records = float_data(records);
      scratch.splat_starts = int_data(splat_starts);
    }
    const Splats splats = {float_data(means2d), float_data(depths),        float_data(conics), float_data(opacities),
                           int_data(radii),     int_data(tiles_per_gauss), scratch.records};
    project(scene, splats, scratch.lists, call.stream);

    offsets = memory.ints({scene.images() * scene.tiles() + 1});
    Lists lists = {};
    lists.tile_offsets = int_data(offsets);
    lists.splat_starts = scratch.splat_starts;
    lists.tiles = scene.images() * scene.tiles();
    NumberFromGpu length(call.stream), rows(call.stream);
    scan(scene, lists, length.written_by_kernel(), scratch.lists, call.stream);
    if (packed) scan_visible(scene, splats, scratch, rows, call.stream);
    const Pixels pixels = make_pixels();

    Arena of_lists;
    lists.capacity = capacity;
    lists.keys = scratch.keys;
    lists.instance_splats = scratch.instance_splats;
    if (capacity == 0) {
      lists.capacity = checked(length);
      const size_t keys = of_lists.place<uint64_t>(lists.capacity), instances = of_lists.place<int32_t>(lists.capacity);
      of_lists.make(memory);
      lists.keys = of_lists.at<uint64_t>(keys);
      lists.instance_splats = of_lists.at<int32_t>(instances);
    }
    flatten_ids = memory.ints({lists.capacity});
    isect_ids = memory.longs({lists.capacity});
    lists.flatten_ids = int_data(flatten_ids);
    lists.isect_ids = long_data(isect_ids);
    if (training) {
      sorted = memory.ints({lists.capacity});
      lists.sorted = int_data(sorted);
    }
    fill(scene, splats, lists, scratch.lists, call.stream);
    blend(scene, splats, lists, pixels, call.stream);
    // The kernels above are queued, so the GPU does not idle while the host waits for the length.
    lists.length = checked(length);
    if (lists.length > lists.capacity) return false;
    if (packed) pack_rows(splats, scratch, rows.wait(), lists);
    for (Tensor* t : {&flatten_ids, &splat_ids, &isect_ids, &sorted})
      if (t->numel() > lists.length) *t = view(*t, {lists.length});
    return true;
  }

  // Return the length of the lists. The only host synchronisation: it gives the returned tensors their exact size.
  int64_t checked(const NumberFromGpu& length) const {
    call.finish("rasterize");
    const int64_t found = length.wait();
    check(found < kMostInts, "the splats touch more than 2^31 - 2 tiles in all; render fewer images at a time");
    return found;
  }

  Pixels make_pixels() {
    image = memory.floats(of_images({scene.height, scene.width, scene.image_channels()}));
    alphas = memory.floats(of_images({scene.height, scene.width, 1}));
    if (training) last = memory.ints(of_images({scene.height, scene.width}));
    if (training && scene.expected) expected = memory.floats(of_images({scene.height, scene.width}));
    return {float_data(image), float_data(alphas), float_data(expected), training ? int_data(last) : nullptr};
  }

  // Replace the splats by their packed rows, and keep the values that the gradient needs.
  void pack_rows(const Splats& splats, const ListScratch& scratch, int64_t rows, const Lists& lists) {
    // Keeps the memory alive until the kernels are queued.
    const Tensor dense[] = {means2d, depths, conics, opacities, tiles_per_gauss};
    dense_radii = radii;
    splat_ids = flatten_ids;
    row_of = memory.ints({scene.images() * scene.gaussians});
    batch_ids = memory.longs({rows});
    camera_ids = memory.longs({rows});
    gaussian_ids = memory.longs({rows});
    means2d = memory.floats({rows, 2});
    depths = memory.floats({rows});
    conics = memory.floats({rows, 3});
    opacities = memory.floats({rows});
    radii = memory.ints({rows, 2});
    tiles_per_gauss = memory.ints({rows});
    flatten_ids = memory.ints({lists.length});
    const PackedSplats out = {long_data(batch_ids),
                              long_data(camera_ids),
                              long_data(gaussian_ids),
                              {float_data(means2d), float_data(depths), float_data(conics), float_data(opacities),
                               int_data(radii), int_data(tiles_per_gauss), nullptr},
                              int_data(row_of)};
    pack(scene, splats, scratch.visible_starts, out, call.stream);
    renumber(lists.length, out.row_of, lists.flatten_ids, int_data(flatten_ids), call.stream);
  }

  // Return a contiguous view of the first elements of a tensor.
  static Tensor view(const Tensor& of, const Sizes& sizes) {
    Sizes strides(sizes.size());
    int64_t stride = 1;
    for (size_t i = sizes.size(); i-- > 0;) {
      strides[i] = stride;
      stride *= sizes[i];
    }
    AtenTensorHandle handle = nullptr;
    check(aoti_torch__reinterpret_tensor(of.get(), int64_t(sizes.size()), sizes.data(), strides.data(), 0, &handle) == 0,
          "torch could not make a view");
    return Tensor(handle);
  }

  std::vector<Tensor> outputs() const {
    std::vector<Tensor> all = {image,       alphas,          means2d,
                               depths,      conics,          opacities,
                               radii,       tiles_per_gauss, view(offsets, of_images({scene.tile_height, scene.tile_width})),
                               flatten_ids, isect_ids};
    if (packed) all.insert(all.end(), {batch_ids, camera_ids, gaussian_ids});
    if (training) all.insert(all.end(), {records, splat_starts, sorted, last, expected});
    if (training && packed) all.insert(all.end(), {row_of, dense_radii, splat_ids});
    return all;
  }
};

std::vector<Tensor> rasterize(OptionalTensors inputs, std::vector<int64_t> image_dims, std::vector<int64_t> options,
                              std::vector<double> ranges, bool training) {
  check(!inputs.empty() && inputs[kMeans].has_value(), "rasterize needs means");
  const Tensor& means = *inputs[kMeans];
  const CudaCall call(means);
  const Request request(image_dims, options, ranges);
  const SceneInputs scene(call, request, inputs);
  Pass pass(call, means, scene.scene, image_dims, options[kPacked] != 0, training);
  if (!pass.run(options[kCapacity])) pass.run(0);
  call.finish("rasterize");
  return pass.outputs();
}

}  // namespace
}  // namespace gsplat::rasterization

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) { m.impl("rasterize", GSPLAT_BOX(&gsplat::rasterization::rasterize)); }
