# Mends what CMake stumbles over when ROS 2 comes from PyPI.  Given from outside, as
# -DCMAKE_PROJECT_INCLUDE=.../ros_wheels.cmake, and by builds with the wheels only: a ROS from apt
# needs none of it, and CMakeLists.txt does not know of it.
cmake_minimum_required(VERSION 3.20)

# 1. The wheels' *__rosidl_generator_pyExport.cmake files name the Python of the machine that built
#    them (/opt/python/cp3XX-cp3XX/...): include folders that do not exist here are dropped.
function(_ros_wheels_drop_missing_includes)
  get_property(_targets DIRECTORY "${CMAKE_SOURCE_DIR}" PROPERTY IMPORTED_TARGETS)
  foreach(_target IN LISTS _targets)
    get_target_property(_dirs ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_dirs)
      set(_kept)
      foreach(_dir IN LISTS _dirs)
        if(_dir MATCHES "^\\$<" OR EXISTS "${_dir}")
          list(APPEND _kept "${_dir}")
        endif()
      endforeach()
      set_property(TARGET ${_target} PROPERTY INTERFACE_INCLUDE_DIRECTORIES "${_kept}")
    endif()
  endforeach()
endfunction()

# 2. An environment inside the checkout (.venv) puts numpy's headers below the source folder, and CMake
#    refuses to export a target that names such a path: it is kept for this build and left out of the export.
function(_ros_wheels_keep_source_includes_private)
  get_property(_targets DIRECTORY "${CMAKE_SOURCE_DIR}" PROPERTY BUILDSYSTEM_TARGETS)
  foreach(_target IN LISTS _targets)
    get_target_property(_dirs ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_dirs)
      set(_kept)
      foreach(_dir IN LISTS _dirs)
        cmake_path(IS_PREFIX CMAKE_SOURCE_DIR "${_dir}" _inside)
        if(_inside)
          list(APPEND _kept "$<BUILD_INTERFACE:${_dir}>")
        else()
          list(APPEND _kept "${_dir}")
        endif()
      endforeach()
      set_property(TARGET ${_target} PROPERTY INTERFACE_INCLUDE_DIRECTORIES "${_kept}")
    endif()
  endforeach()
endfunction()

if(CMAKE_CURRENT_SOURCE_DIR STREQUAL CMAKE_SOURCE_DIR)
  cmake_language(DEFER DIRECTORY "${CMAKE_SOURCE_DIR}" CALL _ros_wheels_drop_missing_includes)
  cmake_language(DEFER DIRECTORY "${CMAKE_SOURCE_DIR}" CALL _ros_wheels_keep_source_includes_private)
endif()
