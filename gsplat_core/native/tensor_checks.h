// Tensor checks and typed access to tensor data, shared by the ops' host files.
#pragma once

#include <initializer_list>
#include <optional>

#include "torch_abi.h"

using gsplat::check;
using torch::stable::Tensor;
using OptionalTensor = std::optional<Tensor>;
using ScalarType = torch::headeronly::ScalarType;

inline const float* data(const Tensor& t) { return t.const_data_ptr<float>(); }
inline const float* data(const OptionalTensor& t) { return t.has_value() ? data(*t) : nullptr; }
inline float* mutable_data(const Tensor& t) { return t.mutable_data_ptr<float>(); }

inline const char* name_of(ScalarType type) {
  switch (type) {
    case ScalarType::Float: return "float32";
    case ScalarType::Double: return "float64";
    case ScalarType::Half: return "float16";
    case ScalarType::Byte: return "uint8";
    case ScalarType::Short: return "int16";
    case ScalarType::Int: return "int32";
    case ScalarType::Long: return "int64";
    case ScalarType::Bool: return "bool";
    default: return "another type";
  }
}

// Argument conversion of an op call, for both devices. `Call` provides take(tensor, type, name): the contiguous tensor,
// checked for its dtype and device.
template <class Call>
class CallArguments {
 public:
  Tensor floats(const Tensor& t, const char* name) const { return self().take(t, ScalarType::Float, name); }
  Tensor ints(const Tensor& t, const char* name) const { return self().take(t, ScalarType::Int, name); }
  OptionalTensor floats(const OptionalTensor& t, const char* name) const { return take_optional(t, ScalarType::Float, name); }
  OptionalTensor ints(const OptionalTensor& t, const char* name) const { return take_optional(t, ScalarType::Int, name); }
  OptionalTensor take_optional(const OptionalTensor& t, ScalarType type, const char* name) const {
    if (!t.has_value()) return std::nullopt;
    return self().take(*t, type, name);
  }

  // Check a tensor that the op updates in place. It must be contiguous already, because a copy would receive the
  // update.
  void in_place(const Tensor& t, ScalarType type, const char* name) const {
    check(t.is_contiguous(), name, " is updated in place and must be contiguous");
    self().take(t, type, name);
  }
  void in_place(const Tensor& t, const char* name) const { in_place(t, ScalarType::Float, name); }

 protected:
  static Tensor contiguous(const Tensor& t, ScalarType type, const char* name) {
    check(t.scalar_type() == type, name, " must be ", name_of(type), ", got ", name_of(t.scalar_type()));
    return t.is_contiguous() ? t : torch::stable::contiguous(t);
  }

 private:
  const Call& self() const { return static_cast<const Call&>(*this); }
};
