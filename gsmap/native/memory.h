// Memory for many values at once.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace gsmap {

// Allocates for vectors: from the system directly where it is much, in large pages if there are any. A page is cleared when
// it is first touched, and 4 kB at a time that costs more than much that is done with them; and what is given back is gone.
template <class T> struct Roomy {
    using value_type = T;
    Roomy() = default;
    template <class Other> Roomy(const Roomy<Other> &) {}
    T *allocate(std::size_t count) {
        if (count > PTRDIFF_MAX / sizeof(T)) throw std::bad_array_new_length();
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        if (from_system(count)) {
            void *out = mmap(nullptr, count * sizeof(T), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
            if (out == MAP_FAILED) throw std::bad_alloc();
            madvise(out, count * sizeof(T), MADV_HUGEPAGE);  // a wish
            return static_cast<T *>(out);
        }
#endif
        return static_cast<T *>(::operator new(count * sizeof(T)));
    }
    void deallocate(T *at, std::size_t count) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        if (from_system(count)) {
            munmap(at, count * sizeof(T));
            return;
        }
#endif
        ::operator delete(at);
    }
    // Whether so many come from the system, as zeros.
    static bool from_system(std::size_t count) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        return count * sizeof(T) >= kMany;
#else
        return false;
#endif
    }
    bool operator==(const Roomy &) const { return true; }
    bool operator!=(const Roomy &) const { return false; }

  private:
    static constexpr std::size_t kMany = std::size_t(1) << 22;
};

// A vector of many.
template <class T> using Many = std::vector<T, Roomy<T>>;

// So many zeros. Where they are many, what is never touched takes no memory, and the rest is cleared once.
template <class T> class Zeros {
  public:
    explicit Zeros(std::size_t count = 0) : size_(count), at_(count ? Roomy<T>().allocate(count) : nullptr) {
        if (!Roomy<T>::from_system(count)) std::uninitialized_value_construct_n(at_, count);
    }
    Zeros(Zeros &&other) noexcept { swap(other); }
    Zeros &operator=(Zeros &&other) noexcept {
        swap(other);
        return *this;
    }
    ~Zeros() {
        if (at_) Roomy<T>().deallocate(at_, size_);
    }
    void swap(Zeros &other) noexcept {
        std::swap(size_, other.size_);
        std::swap(at_, other.at_);
    }
    std::size_t size() const { return size_; }
    T &operator[](std::size_t i) { return at_[i]; }
    const T &operator[](std::size_t i) const { return at_[i]; }
    T *begin() { return at_; }
    T *end() { return at_ + size_; }
    const T *begin() const { return at_; }
    const T *end() const { return at_ + size_; }

  private:
    std::size_t size_ = 0;
    T *at_ = nullptr;
    static_assert(std::is_trivially_destructible<T>::value && std::is_trivially_copyable<T>::value, "zeros are values");
};

}  // namespace gsmap
